"""Draw slices of the likelihood field: of poses about the truth, and of single points in the
object's frame.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from posefilter.figures.canvas import (
    AXES,
    ESTIMATE,
    TRUTH,
    Color,
    arrange_grid,
    draw_dots,
    full_view,
)
from posefilter.figures.layout import (
    CAPTION,
    DETAIL,
    add_caption,
    compose_figure,
    draw_legend,
    draw_text,
    tile_width,
)
from posefilter.figures.overlay import list_axes
from posefilter.figures.panels import (
    SURFACE,
    Axis,
    Mark,
    draw_color_scale,
    draw_curve_panel,
    draw_heat_panel,
    map_colors,
)

PLANES = ((0, 1), (0, 2), (1, 2))  # of object axes
_NAMES = "xyz"
_ABOVE: Color = (15, 15, 15)  # no color of the scale, and plain on its bright end, where it matters
_COLUMN = tile_width(3)  # [px] one for each noise level, of which there are three at most
_FINE = 5  # times finer than the cells that were scored: what lies between is interpolated


class PoseField(NamedTuple):
    """Scores about the truth of one image, less the truth's own."""

    sigmas: tuple[float, ...]  # (L,) noise levels [m]
    extents: tuple[float, ...]  # (L,) how far the slices go [m]
    # (L, 3, G, G): plane (a, b); rows by the shift along axis b, columns by that along a, both
    # rising
    planes: np.ndarray
    degrees: np.ndarray  # (A,)
    turns: np.ndarray  # (L, 3, A): turned about each of the object's axes


class PointField(NamedTuple):
    """Judgements of one image point, as if it lay elsewhere in a plane of the object's frame."""

    pixel: tuple[int, int]  # (u, v)
    on: bool  # whether it is the object's
    place: np.ndarray  # (3,) where it lies under the true pose, from the object's center [m]
    plane: tuple[int, int]  # the two object axes that span the slice through `place`
    extent: float  # the slice goes from -extent to extent about the object's center [m]
    sigmas: tuple[float, ...]  # (L,) [m]
    scores: np.ndarray  # (L, G, G), rows and columns as in PoseField
    own: np.ndarray  # (L,) at `place`


def draw_pose_field(field: PoseField, title: str, estimate: np.ndarray | None = None) -> np.ndarray:
    """Draw a column a noise level: three planes of translations, and the rotations about the
    object's axes.

    estimate: (3,) where the estimate's center lies, from the true one, along the object's axes [m].
    """
    rows: list[list[np.ndarray]] = [[], [], [], []]
    for k, (sigma, extent) in enumerate(zip(field.sigmas, field.extents, strict=True)):
        own = np.concatenate([field.planes[k].ravel(), field.turns[k].ravel()])
        low = min(float(np.percentile(own, 2)), -1e-3)
        for row, (a, b), values in zip(rows[:3], PLANES, field.planes[k], strict=True):
            x, y = (make_shift_axis(f"along {_NAMES[axis]} [mm]", extent) for axis in (a, b))
            marks = [Mark(0, 0, TRUTH)]
            if estimate is not None:
                u, v = 1000 * float(estimate[a]), 1000 * float(estimate[b])
                marks.append(Mark(u, v, ESTIMATE, "square"))
            row.append(draw_heat_panel(color_scores(values, low), x, y, _COLUMN, marks))
        ends = draw_color_scale(f"{low:.3g}", "0", width=_COLUMN, size=DETAIL)
        rows[0][-1] = add_caption(np.concatenate([ends, rows[0][-1]]), f"{1000 * sigma:.3g} mm")
        x = Axis("rotation [degrees]", -180, 180, (-180, 0, 180))
        top = max(1.15 * max(float(own.max()), 0.0), -0.06 * low)
        y = Axis("score", low, top, (round_down(low), 0))
        lines = list(zip(field.turns[k], AXES, strict=True))
        rows[3].append(draw_curve_panel(lines, field.degrees, x, y, _COLUMN, 170))
    entries = [("truth", TRUTH), *([] if estimate is None else [("estimate", ESTIMATE)])]
    (first, red), *others = list_axes()
    entries += [("beats truth", _ABOVE), (f"rotation {first}", red), *others]
    note = (
        "score: log-likelihood less the truth's [nat], of the true pose translated along and "
        "rotated about the object's axes"
    )
    parts = [
        draw_text("at noise levels of", CAPTION),
        *(arrange_grid(row, len(row)) for row in rows),
        draw_text(note, DETAIL),
    ]
    return compose_figure(title, *parts, draw_legend(entries))


def color_scores(values: np.ndarray, low: float) -> np.ndarray:
    """Return scores less the truth's as colors, `low` to 0, black where they are above.

    (G, G) -> finer, (*, 3) uint8.
    """
    side = (len(values) - 1) * _FINE + 1
    spots = np.linspace(0, len(values) - 1, side, dtype=np.float32)
    u, v = np.meshgrid(spots, spots)
    fine = cv2.remap(values.astype(np.float32), u, v, cv2.INTER_LINEAR)
    out = map_colors(fine, low, 0.0)
    out[fine > max(-0.002 * low, 1e-6)] = _ABOVE
    return out


def make_shift_axis(label: str, extent: float) -> Axis:
    """Return an axis from -extent to extent [m] that is labeled in millimeters."""
    tick = round_down(1000 * extent * 0.9)
    return Axis(label, -1000 * extent, 1000 * extent, (-tick, 0, tick))


def round_down(value: float) -> float:
    """Return the number of one digit, or of 1.5 or 2.5, next to a value towards 0."""
    if value == 0:
        return 0.0
    power = 10.0 ** np.floor(np.log10(abs(value)))
    most = abs(value) * (1 + 1e-9)
    step = max(x for x in (1, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 9) if x * power <= most)
    return float(np.sign(value) * step * power)


def draw_point_field(
    fields: Sequence[PointField], rgb: np.ndarray, surface: np.ndarray, title: str
) -> np.ndarray:
    """Draw a row a slice, a column a noise level, below photographs of the points that they are
    about.

    rgb (H, W, 3) uint8; surface (P, 3): points of the object's surface from its center [m]; those
    near a slice are shown.
    """
    pixels = {field.on: field.pixel for field in fields}
    photographs = [
        add_caption(draw_marked_pixel(rgb, pixel), "a point on it" if on else "a point off it")
        for on, pixel in pixels.items()
    ]
    parts = [arrange_grid(photographs, 2)]
    for field in fields:
        a, b = field.plane
        (normal,) = {0, 1, 2} - {a, b}
        near = np.abs(surface[:, normal] - field.place[normal]) < 0.06 * field.extent
        dots = 1000 * surface[near][:, [a, b]]
        marks = [Mark(1000 * float(field.place[a]), 1000 * float(field.place[b]), TRUTH)]
        x, y = (make_shift_axis(f"object's {_NAMES[axis]} [mm]", field.extent) for axis in (a, b))
        most = max(float(np.abs(field.scores).max()), float(np.abs(field.own).max()), 1e-6)
        tiles = []
        for sigma, scores, own in zip(field.sigmas, field.scores, field.own, strict=True):
            colors = map_colors(scores, -most, most, "RdBu_r")
            panel = draw_heat_panel(colors, x, y, _COLUMN, marks, dots)
            note = f"at the ring: {own:+.2f}"
            tiles.append(add_caption(panel, f"{1000 * sigma:.3g} mm", note=note))
        place = f"plane {_NAMES[normal]} = {1000 * field.place[normal]:.0f} mm"
        head = f"{'On' if field.on else 'Off'} it: {place}, at noise levels of"
        scale = draw_color_scale(f"score: {-most:.2g}", f"{most:+.2g}", "RdBu_r", size=CAPTION)
        parts += [draw_text(head, CAPTION), arrange_grid(tiles, len(tiles)), scale]
    entries = [("where the truth puts it", TRUTH), ("surface near the slice", SURFACE)]
    return compose_figure(title, *parts, draw_legend(entries))


def draw_marked_pixel(rgb: np.ndarray, pixel: tuple[int, int]) -> np.ndarray:
    """Return the photograph with a ring round a pixel (u, v)."""
    view = full_view(rgb.shape[0], rgb.shape[1], tile_width(2))
    picture = view.show(rgb)
    at = view.place(np.array([pixel]))
    draw_dots(picture, at, (0, 0, 0), 7)
    draw_dots(picture, at, TRUTH, 5)
    return picture
