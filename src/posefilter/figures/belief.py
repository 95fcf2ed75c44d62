"""Draw a belief about one pose over all six axes: rotation on a map of the sphere, and the
marginals of each axis.

The map follows Murphy et al. 2021 (Implicit-PDF, figure 3): a rotation is a point where one of the
object's axes points, and a color for the turn about that axis. Ours looks along the camera: the
center is towards it, right and up are the image's.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from posefilter.figures.belief_summary import describe_belief, summarize_belief
from posefilter.figures.canvas import Color, View, arrange_grid, draw_dots, halve
from posefilter.figures.curves import choose_ticks
from posefilter.figures.layout import (
    CAPTION,
    DETAIL,
    add_caption,
    compose_figure,
    draw_legend,
    draw_text,
    tile_width,
)
from posefilter.figures.mollweide import (
    color_by_turn,
    draw_blank_map,
    draw_turn_scale,
    label_map,
    map_to_sphere,
    project_to_map,
)
from posefilter.figures.panels import Axis, arrange_row, draw_histogram_panel, draw_mark
from posefilter.figures.particles import color_by_weight, draw_weight_scale, fade
from posefilter.geometry.camera import project
from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.geometry.rotation import log_so3
from posefilter.types import Belief, ObjectModel

_TRUE: Color = (21, 153, 71)  # darker than on photographs: these are read on white
_BEST: Color = (214, 33, 156)
_SECOND: Color = (226, 110, 0)
_NAMES = "xyz"
_REACH = {"ring": 44, "square": 20, "diamond": 32}  # [px] of marks, at twice the size
_AWAY = ("right", "down", "away")  # camera axes


class Mark(NamedTuple):
    """A pose that is pointed at."""

    pose: torch.Tensor  # (4, 4)
    color: Color
    shape: str  # of panels.draw_mark


def draw_belief(
    belief: Belief,
    model: ObjectModel,
    rgb: np.ndarray,
    K: np.ndarray,
    truth: np.ndarray | None = None,
    title: str = "",
    axis: int | None = None,
) -> np.ndarray:
    """Draw the belief of one image: its rotations on a map, its centers on the photograph, and six
    marginals.

    belief: of one image, with its leading dimension of 1 or without; rgb (H, W, 3) uint8; K (3, 3)
    [px]; truth (4, 4); axis: the object's axis on the map (its longest, if None).
    """
    poses, weights, best = select_single(belief)
    true = None if truth is None else torch.as_tensor(np.asarray(truth), dtype=torch.float64)
    axis = find_longest_axis(model) if axis is None else axis
    ess = float(1 / weights.square().sum())
    summary = summarize_belief(poses, weights, best, model)
    sure, other = describe_belief(summary)
    marks = [Mark(best, _BEST, "square"), *([] if true is None else [Mark(true, _TRUE, "ring")])]
    entries = [("estimate", _BEST), *([] if true is None else [("truth", _TRUE)])]
    if summary.second is not None:
        marks.append(Mark(torch.from_numpy(summary.second.pose).double(), _SECOND, "diamond"))
        entries.append(("second pose", _SECOND))
    half = tile_width(2)
    words = [
        f"{len(weights)} particles, {ess:.0f} effective.",
        f"±: root mean square in the estimate's mode, {summary.share:.0%} of the belief.",
        f"Map, above: where the object's {_NAMES[axis]} axis points, colored by the turn about it.",
        "Photograph: where the particles put the object's center, colored by weight.",
        "Below: shares of the belief. Shifts are from its mean, turns from the estimate.",
    ]
    notes = np.concatenate(
        [draw_legend(entries, half), *(draw_text(text, DETAIL, half) for text in words)]
    )
    return compose_figure(
        title or f"Belief\n{model.name}",
        draw_text(sure, CAPTION, bold=True),
        draw_text(other, CAPTION),
        draw_rotations(poses, weights, marks, axis, tile_width(1)),
        draw_turn_scale(),
        arrange_row(
            [arrange_grid([draw_centers(poses, weights, marks, model, rgb, K, half)], 1), notes]
        ),
        draw_weight_scale(),
        *draw_marginals(poses, weights, best, true, model),
    )


def select_single(belief: Belief) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the poses (N, 4, 4), weights (N,) that sum to 1, and estimate (4, 4) of a belief about
    one image.
    """
    poses, log_weights, best = (
        x.detach().cpu().double() for x in (belief.poses, belief.log_weights, belief.best)
    )
    if poses.ndim == 4:
        if len(poses) != 1:
            raise ValueError(f"a belief about one image is due, not about {len(poses)}")
        poses, log_weights, best = poses[0], log_weights[0], best[0]
    return poses, torch.softmax(log_weights, 0), best


def find_longest_axis(model: ObjectModel) -> int:
    """Return which of the object's axes its bounding box is longest along; the last of equals."""
    size = (model.hull.max(0).values - model.hull.min(0).values).tolist()
    return max(range(3), key=lambda i: (round(size[i], 4), i))


def draw_rotations(
    poses: torch.Tensor, weights: torch.Tensor, marks: Sequence[Mark], axis: int, width: int
) -> np.ndarray:
    """Draw rotations on a Mollweide map: place = where the axis points, color = turn about it, area
    = weight.
    """
    fine = 2 * width  # drawn at twice the size and shrunk: OpenCV's smallest discs are no discs
    picture = draw_blank_map(fine)
    longitude, latitude, tilt = (x.numpy() for x in map_to_sphere(rotation_of(poses), axis))
    order = np.argsort(weights.numpy(), kind="stable")
    places = project_to_map(longitude, latitude, fine)[order]
    draw_dots(picture, places, color_by_turn(tilt)[order], scale_radii(weights.numpy())[order])
    taken = []
    for mark in marks[::-1]:
        u, v, _ = (x.numpy() for x in map_to_sphere(rotation_of(mark.pose)[None], axis))
        at = project_to_map(u, v, fine)[0]
        draw_mark(picture, at, mark.color, mark.shape, _REACH[mark.shape], 7)
        taken.append(at)
    return halve(label_map(picture, np.array(taken)))


def scale_radii(weights: np.ndarray, least: float = 3.0, most: float = 11.0) -> np.ndarray:
    """Return radii of discs whose areas grow with weights (N,): `least` at none, `most` at the
    heaviest.  -> (N,) [px].
    """
    share = weights / max(float(weights.max()), 1e-300)
    return np.asarray(np.sqrt(least**2 + (most**2 - least**2) * share))


def draw_centers(
    poses: torch.Tensor,
    weights: torch.Tensor,
    marks: Sequence[Mark],
    model: ObjectModel,
    rgb: np.ndarray,
    K: np.ndarray,
    size: int,
) -> np.ndarray:
    """Draw on the photograph where particles put the object's center, cut to the object as the
    first mark has it.
    """
    camera = torch.as_tensor(np.asarray(K), dtype=torch.float64)
    center = model.center.cpu().double()
    dots = project(origin_of(poses, center), camera).numpy()
    order = np.argsort(weights.numpy(), kind="stable")
    best = marks[0].pose
    left, top, right, _ = choose_window(
        dots, weights.numpy(), best, model, camera.numpy(), *rgb.shape[:2]
    )
    view = View(left, top, 2 * size / (right - left), 2 * size, 2 * size)
    picture = fade(view.show(rgb), 0.4)
    draw_dots(picture, view.place(dots[order]), color_by_weight(weights.numpy())[order], 5)
    for mark in marks[::-1]:
        at = project(origin_of(mark.pose, center)[None], camera).numpy()
        draw_mark(picture, view.place(at)[0], mark.color, mark.shape, 0.75 * _REACH[mark.shape], 5)
    return halve(picture)


def choose_window(
    dots: np.ndarray,
    weights: np.ndarray,
    best: torch.Tensor,
    model: ObjectModel,
    K: np.ndarray,
    height: int,
    width: int,
) -> tuple[float, float, float, float]:
    """Return the square part of the frame that shows the object as estimated, and 98 % of the
    particles.  -> [px].
    """
    z = max(float(origin_of(best, model.center.cpu().double())[2]), 0.05)
    middle = project(origin_of(best, model.center.cpu().double())[None], torch.as_tensor(K))[
        0
    ].numpy()
    reach = 1.1 * model.radius * K[0, 0] / z
    far = np.abs(dots - middle).max(1)
    order = np.argsort(far)
    reach = max(
        reach,
        float(far[order][np.searchsorted(np.cumsum(weights[order]), 0.98).clip(max=len(far) - 1)])
        * 1.1,
    )
    reach = min(reach, max(height, width) / 2)
    u = float(np.clip(middle[0], min(reach, width / 2), max(width - reach, width / 2)))
    v = float(np.clip(middle[1], min(reach, height / 2), max(height - reach, height / 2)))
    return u - reach, v - reach, u + reach, v + reach


def compute_shifts_and_turns(
    poses: torch.Tensor, reference: torch.Tensor, mean: torch.Tensor, center: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return centers less `mean`, camera axes (*, 3) [m], and turns from the reference, object axes
    (*, 3) [rad].
    """
    turn = log_so3(rotation_of(reference).mT @ rotation_of(poses))
    return origin_of(poses, center) - mean, turn


class Marginal(NamedTuple):
    """One axis of the belief."""

    mass: np.ndarray  # (M,) shares of the belief
    edges: np.ndarray  # (M + 1,)
    marks: tuple[float, ...]  # the estimate's value, and the truth's where it is known
    beyond: float  # share of the belief outside the edges


def compute_marginals(
    poses: torch.Tensor,
    weights: torch.Tensor,
    best: torch.Tensor,
    true: torch.Tensor | None,
    center: torch.Tensor,
) -> tuple[list[Marginal], list[Marginal]]:
    """Return three shifts from the mean, camera axes [mm], and three turns from the estimate,
    object axes [degrees].
    """
    mean = (weights[:, None] * origin_of(poses, center)).sum(0)
    parts = [
        compute_shifts_and_turns(p, best, mean, center)
        for p in (poses, best, true)
        if p is not None
    ]
    out: tuple[list[Marginal], list[Marginal]] = ([], [])
    for kind, unit in enumerate((1000.0, 180 / math.pi)):
        for i in range(3):
            marks = [float(part[kind][i]) * unit for part in parts[1:]]
            out[kind].append(
                compute_histogram(parts[0][kind][:, i].numpy() * unit, weights.numpy(), marks)
            )
    return out


def draw_marginals(
    poses: torch.Tensor,
    weights: torch.Tensor,
    best: torch.Tensor,
    true: torch.Tensor | None,
    model: ObjectModel,
) -> list[np.ndarray]:
    """Draw six weighted histograms, in two rows with what they are above them."""
    shifts, turns = compute_marginals(poses, weights, best, true, model.center.cpu().double())
    names = [[f"{_AWAY[i]} [mm]" for i in range(3)], [f"about {name} [degrees]" for name in _NAMES]]
    out = []
    for kind, row, labels in (
        ("shift of the center", shifts, names[0]),
        ("turn about the object's axes", turns, names[1]),
    ):
        out.append(draw_text(kind, CAPTION))
        out.append(
            arrange_grid(
                [draw_marginal(one, label) for one, label in zip(row, labels, strict=True)], 3
            )
        )
    return out


def draw_marginal(one: Marginal, label: str) -> np.ndarray:
    """Draw one histogram."""
    low, high = float(one.edges[0]), float(one.edges[-1])
    top = 1.1 * max(float(one.mass.max()), 1e-6)
    x, y = (
        Axis(label, low, high, choose_ticks(low, high, 3, 3 if max(-low, high) < 100 else 2)),
        Axis("share", 0, top, choose_ticks(0, top, 2)),
    )
    marks = list(zip(one.marks, (_BEST, _TRUE), strict=False))[::-1]
    note = f"{one.beyond:.1%} lies beyond" if one.beyond >= 5e-4 else ""
    return add_caption(
        draw_histogram_panel(one.mass, one.edges, marks, x, y, tile_width(3), 160), note, DETAIL
    )


def compute_histogram(
    values: np.ndarray, weights: np.ndarray, marks: list[float], bins: int = 25
) -> Marginal:
    """Return a weighted histogram of the middle 95 % and a margin, wide enough for the marks."""
    order = np.argsort(values)
    mass = np.cumsum(weights[order])
    low, high = (
        float(values[order][min(int(np.searchsorted(mass, q)), len(values) - 1)])
        for q in (0.025, 0.975)
    )
    margin = max(0.3 * (high - low), 1e-2)
    low, high = min(low - margin, *marks), max(high + margin, *marks)
    pad = 0.02 * (high - low)
    mass, edges = np.histogram(
        values, np.linspace(low - pad, high + pad, bins + 1), weights=weights
    )
    beyond = float(weights[(values < low - pad) | (values > high + pad)].sum())
    return Marginal(mass, edges, (*marks,), beyond)
