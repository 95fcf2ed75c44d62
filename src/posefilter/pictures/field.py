"""Draw slices of the likelihood field: of poses about the truth, and of single points in the object's frame."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from posefilter.pictures.canvas import AXES, ESTIMATE, TRUTH, Colour, draw_dots, strip, whole
from posefilter.pictures.overlay import axes_legend
from posefilter.pictures.panels import (
    BOTTOM,
    SURFACE,
    TOP,
    Axis,
    Mark,
    beside,
    colours,
    curve_panel,
    heat_panel,
    upright_bar,
)

PLANES = ((0, 1), (0, 2), (1, 2))  # of object axes
_NAMES = "xyz"
_ABOVE: Colour = (15, 15, 15)  # no colour of the scale, and plain on its bright end, where it matters
_SIZE = 190  # [px] a slice
_FINE = 5  # times finer than the cells that were judged: what lies between is interpolated


class PoseField(NamedTuple):
    """Scores about the truth of one image, less the truth's own."""

    sigmas: tuple[float, ...]  # (L,) noise levels [m]
    reaches: tuple[float, ...]  # (L,) how far the slices go [m]
    planes: np.ndarray  # (L, 3, G, G): plane (a, b); rows by the shift along axis b, columns by that along a, both rising
    degrees: np.ndarray  # (A,)
    turns: np.ndarray  # (L, 3, A): turned about each of the object's axes


class PointField(NamedTuple):
    """Judgements of one image point, as if it lay elsewhere in a plane of the object's frame."""

    pixel: tuple[int, int]  # (u, v)
    on: bool  # whether it is the object's
    place: np.ndarray  # (3,) where it lies under the true pose, from the object's centre [m]
    plane: tuple[int, int]  # the two object axes that span the slice through `place`
    reach: float  # the slice goes from -reach to reach about the object's centre [m]
    sigmas: tuple[float, ...]  # (L,) [m]
    judged: np.ndarray  # (L, G, G), rows and columns as in PoseField
    own: np.ndarray  # (L,) at `place`


def draw_pose_field(field: PoseField, title: str, estimate: np.ndarray | None = None) -> np.ndarray:
    """Draw a row a noise level: three planes of shifts, and the turns about the object's axes.

    estimate: (3,) where the estimate's centre lies, from the true one, along the object's axes [m].
    """
    rows = []
    for k, (sigma, reach) in enumerate(zip(field.sigmas, field.reaches, strict=True)):
        own = np.concatenate([field.planes[k].ravel(), field.turns[k].ravel()])
        low = min(float(np.percentile(own, 2)), -1e-3)
        panels = []
        for (a, b), values in zip(PLANES, field.planes[k], strict=True):
            x, y = (shift_axis(f"shift in {_NAMES[axis]} [mm]", reach) for axis in (a, b))
            marks = [Mark(0, 0, TRUTH)]
            if estimate is not None:
                marks.append(Mark(1000 * float(estimate[a]), 1000 * float(estimate[b]), ESTIMATE, "square"))
            panels.append(
                heat_panel(score_colours(values, low), x, y, f"object's {_NAMES[a]}-{_NAMES[b]} plane", _SIZE, marks)
            )
        high = max(float(own.max()), 0.0)
        x = Axis("turn about an axis [degrees]", -180, 180, (-180, -90, 0, 90, 180))
        y = Axis("", low, max(1.15 * high, -0.06 * low), (round_down(low), 0))
        lines = [(curve, colour) for curve, colour in zip(field.turns[k], AXES, strict=True)]
        bar = upright_bar(f"{low:.3g}", "0", "score", _SIZE)
        panels += [bar, curve_panel(lines, field.degrees, x, y, "score of turns", 230, _SIZE)]
        row = beside(panels)
        rows += [strip(row.shape[1], f"Noise level {1000 * sigma:.3g} mm", size=18), row]
    width = rows[0].shape[1]
    legend = [("truth", TRUTH), *([] if estimate is None else [("estimate", ESTIMATE)]), ("outscores the truth", _ABOVE)]
    legend += [(f"turn about {name}", colour) for name, colour in axes_legend()]
    foot = strip(width, "score: log-likelihood less the truth's [nat]", legend, size=15)
    return np.concatenate([strip(width, title, size=20), *rows, foot])


def score_colours(values: np.ndarray, low: float) -> np.ndarray:
    """Return scores less the truth's as colours, `low` to 0, black where they are above.  (G, G) -> finer, (*, 3) uint8."""
    side = (len(values) - 1) * _FINE + 1
    spots = np.linspace(0, len(values) - 1, side, dtype=np.float32)
    u, v = np.meshgrid(spots, spots)
    fine = cv2.remap(values.astype(np.float32), u, v, cv2.INTER_LINEAR)
    out = colours(fine, low, 0.0)
    out[fine > max(-0.002 * low, 1e-6)] = _ABOVE
    return out


def shift_axis(label: str, reach: float) -> Axis:
    """Return an axis from -reach to reach [m] that is labelled in millimetres."""
    tick = round_down(1000 * reach * 0.9)
    return Axis(label, -1000 * reach, 1000 * reach, (-tick, 0, tick))


def round_down(value: float) -> float:
    """Return the number of one digit, or of 1.5 or 2.5, next to a value towards 0."""
    if value == 0:
        return 0.0
    power = 10.0 ** np.floor(np.log10(abs(value)))
    steps = [step for step in (1, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 9) if step * power <= abs(value) * (1 + 1e-9)]
    return float(np.sign(value) * steps[-1] * power)


def draw_point_field(fields: Sequence[PointField], rgb: np.ndarray, surface: np.ndarray, title: str) -> np.ndarray:
    """Draw a row a slice, a column a noise level; beside each row the photograph with the pixel.

    rgb (H, W, 3) uint8; surface (P, 3): points of the object's surface from its centre [m]; those near a slice are shown.
    """
    rows = []
    for field in fields:
        a, b = field.plane
        (normal,) = {0, 1, 2} - {a, b}
        near = np.abs(surface[:, normal] - field.place[normal]) < 0.06 * field.reach
        dots = 1000 * surface[near][:, [a, b]]
        most = max(float(np.abs(field.judged).max()), float(np.abs(field.own).max()), 1e-6)
        panels = [photograph(rgb, field)]
        for k, sigma in enumerate(field.sigmas):
            x, y = (shift_axis(f"object's {_NAMES[axis]} [mm]", field.reach) for axis in (a, b))
            marks = [Mark(1000 * float(field.place[a]), 1000 * float(field.place[b]), TRUTH)]
            cells = colours(field.judged[k], -most, most, "RdBu_r")
            panels.append(
                heat_panel(
                    cells, x, y, f"noise {1000 * sigma:.3g} mm: {field.own[k]:+.2f} at the ring", _SIZE + 20, marks, dots
                )
            )
        panels.append(upright_bar(f"{-most:.2g}", f"{most:+.2g}", "judged", _SIZE + 20, "RdBu_r"))
        row = beside(panels)
        what = "A point on the object" if field.on else "A point off the object"
        place = f"{_NAMES[normal]} = {1000 * field.place[normal]:.0f} mm"
        rows += [
            strip(row.shape[1], f"{what}: what it would be worth elsewhere in the object's plane {place}", size=17),
            row,
        ]
    width = rows[0].shape[1]
    legend = [("where the point is under the true pose", TRUTH), ("surface near the slice", SURFACE)]
    return np.concatenate([strip(width, title, size=20), *rows, strip(width, "", legend, size=15)])


def photograph(rgb: np.ndarray, field: PointField) -> np.ndarray:
    """Return the photograph as high as the row's slices, with a ring round the pixel."""
    size = _SIZE + 20
    view = whole(rgb.shape[0], rgb.shape[1], round(size * rgb.shape[1] / rgb.shape[0]))
    picture = view.show(rgb)
    at = view.place(np.array([field.pixel]))
    draw_dots(picture, at, np.array([[0, 0, 0]]), 7)
    draw_dots(picture, at, np.array([TRUTH]), 5)
    head, foot = (np.full((rows, picture.shape[1], 3), 255, np.uint8) for rows in (TOP, BOTTOM))
    return np.concatenate([head, picture, foot])
