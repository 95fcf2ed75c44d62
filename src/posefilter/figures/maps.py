"""Draw what a network says of every cell of an image: where the object is, which of its points, and
where to look.
"""

from typing import NamedTuple

import cv2
import numpy as np

from posefilter.figures.canvas import (
    TRUTH,
    Color,
    View,
    arrange_grid,
    draw_dots,
    draw_lines,
    full_view,
    halve,
)
from posefilter.figures.layout import (
    DETAIL,
    add_caption,
    compose_figure,
    draw_legend,
    draw_text,
    tile_width,
)
from posefilter.figures.overlay import Shape, list_axes, outline_object, trace_outline
from posefilter.figures.panels import draw_color_scale, map_colors
from posefilter.figures.particles import draw_many_axes, draw_particles, draw_weight_scale

_PROPOSED: Color = (255, 190, 40)


class Proposals(NamedTuple):
    """What the proposal network makes of one image of h x w cells, and what would have been
    right.
    """

    chance: np.ndarray  # (h, w) that the cell shows the object
    coordinates: np.ndarray  # (h, w, 3) object point, from the object's center, over its radius
    true: np.ndarray  # (h, w, 3) the same as the depth and the true pose have it
    on: np.ndarray  # (h, w) bool, where that is the object
    axes: np.ndarray  # (M, 4, 2) [px] center and ends of the axes of poses drawn from it
    error: float  # mean distance of `coordinates` from `true` where `on` [m], NaN where nothing is


def draw_proposals(
    proposals: Proposals,
    rgb: np.ndarray,
    K: np.ndarray,
    truth: np.ndarray,
    shape: Shape,
    radius: float,
    title: str,
) -> np.ndarray:
    """Draw the chance map, the object's points as colors beside the true ones, and poses drawn from
    them.
    """
    view = full_view(rgb.shape[0], rgb.shape[1], tile_width(2))
    edge = outline_object(truth, shape, view.camera(K), view.height, view.width)
    chance = draw_heat_map(rgb, proposals.chance, view)
    draw_lines(chance, edge, TRUTH, 2, closed=True)
    fine = view.finer(2)
    drawn = fine.show(rgb)
    draw_many_axes(drawn, fine.place(proposals.axes), 0.8)
    draw_dots(drawn, fine.place(proposals.axes[:, 0]), _PROPOSED, 5)
    drawn = halve(drawn)
    draw_lines(drawn, edge, TRUTH, 2, closed=True)
    mean = "of the object's own frame"
    if np.isfinite(proposals.error):
        mean = f"{1000 * proposals.error:.0f} mm off on average"
    predicted = draw_point_map(proposals.coordinates, proposals.chance, view)
    true = draw_point_map(proposals.true, proposals.on.astype(float), view)
    tiles = [
        add_caption(chance, "chance", note="that a cell shows the object"),
        add_caption(drawn, f"{len(proposals.axes)} poses drawn", note="from these maps"),
        add_caption(predicted, "points, predicted", note=mean),
        add_caption(true, "points, true", note="by depth and pose"),
    ]
    entries = [("true outline", TRUTH), ("pose's center", _PROPOSED), *list_axes()]
    span = f"{1000 * radius:.0f}"
    reach = f"points: red, green, blue are the object's x, y, z, from -{span} to {span} mm"
    return compose_figure(
        title,
        arrange_grid(tiles, 2),
        draw_legend(entries),
        draw_color_scale("chance: 0", "1", "magma"),
        draw_text(reach, DETAIL),
    )


def draw_point_map(points: np.ndarray, chance: np.ndarray, view: View) -> np.ndarray:
    """Return object points (h, w, 3) in [-1, 1] as colors, the fainter the less likely the object.
    -> picture.
    """
    paint = (np.clip(points, -1, 1) + 1) / 2
    share = np.clip(chance, 0, 1)[..., None]
    cells = (255 * (paint * share + 0.13 * (1 - share))).round().astype(np.uint8)
    return np.asarray(cv2.resize(cells, (view.width, view.height), interpolation=cv2.INTER_NEAREST))


def draw_heat_map(rgb: np.ndarray, values: np.ndarray, view: View) -> np.ndarray:
    """Return a photograph in gray below a map (h, w) in [0, 1] whose cells lie evenly over it.  ->
    picture.
    """
    ground = view.show(rgb).mean(-1, keepdims=True)
    colors = map_colors(values, 0, 1, "magma")
    cells = cv2.resize(colors, (view.width, view.height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(0.35 * ground + 0.65 * cells).round().astype(np.uint8)


def draw_objectness(
    objectness: np.ndarray,
    rgb: np.ndarray,
    mask: np.ndarray,
    first: tuple[np.ndarray, np.ndarray],
    last: tuple[np.ndarray, np.ndarray],
    title: str,
) -> np.ndarray:
    """Draw a map of objectness (h, w) in [0, 1] beside the first and the last particles: pixels
    (N, 2), weights (N,) each.

    mask (H, W) bool: the object's visible part, whose rim is drawn.
    """
    wide, half = (full_view(rgb.shape[0], rgb.shape[1], tile_width(columns)) for columns in (1, 2))
    heat = draw_heat_map(rgb, objectness, wide)
    wide.outline(heat, trace_outline(mask), TRUTH, 3)
    on, off = average_objectness(objectness, mask), average_objectness(objectness, ~mask)
    mean = f"{on:.2f} on the object, {off:.2f} elsewhere"
    tiles = []
    for name, (pixels, weights) in (("first", first), ("last", last)):
        picture = draw_particles(rgb, pixels, weights, half)
        half.outline(picture, trace_outline(mask), TRUTH, 2)
        tiles.append(add_caption(picture, f"the {name} iteration"))
    foot = [
        draw_legend([("rim of the mask", TRUTH)]),
        draw_color_scale("objectness: 0", "1", "magma"),
        draw_weight_scale(),
    ]
    return compose_figure(title, add_caption(heat, mean), arrange_grid(tiles, 2), *foot)


def average_objectness(objectness: np.ndarray, mask: np.ndarray) -> float:
    """Return the mean objectness of a mask's pixels, NaN where there are none.

    (h, w), (H, W) bool.
    """
    if not mask.any():
        return float("nan")
    full = cv2.resize(
        objectness.astype(np.float32), mask.shape[::-1], interpolation=cv2.INTER_NEAREST
    )
    return float(full[mask].mean())
