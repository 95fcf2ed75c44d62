"""Draw a belief about one pose over all six axes: rotation on a map of the sphere, and the
marginals of each axis.

The map follows Murphy et al. 2021 (Implicit-PDF, figure 3): a rotation is a point where one of the
object's axes points, and a color for the rotation about that axis. Ours looks along the camera: the
center is towards it, right and up are the image's.

Above it is said in words how sure the belief is, and which other pose it holds for possible.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch

from posefilter.belief import Belief, Uncertainty
from posefilter.belief.belief import belief_over
from posefilter.figures.canvas import Color, View, arrange_grid, draw_dots, halve
from posefilter.figures.layout import (
    CAPTION,
    DETAIL,
    compose_figure,
    draw_legend,
    draw_text,
    format_length,
    tile_width,
)
from posefilter.figures.marginals import ESTIMATE, OBJECT_AXES, TRUTH, draw_marginals
from posefilter.figures.mollweide import (
    color_by_turn,
    draw_blank_map,
    draw_turn_scale,
    label_map,
    map_to_sphere,
    project_to_map,
)
from posefilter.figures.panels import arrange_row, draw_mark
from posefilter.figures.particles import color_by_weight, draw_weight_scale, fade
from posefilter.figures.view_data import Hypothesis, find_hypotheses
from posefilter.geometry.camera import project
from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.geometry.rotation import angle_between
from posefilter.geometry.spaces import PoseSpace
from posefilter.images import to_camera, to_picture, to_pose
from posefilter.types import BeliefBatch, ObjectModel

_SECOND: Color = (226, 110, 0)
_REACH = {"ring": 44, "square": 20, "diamond": 32}  # [px] of marks, at twice the size


class Mark(NamedTuple):
    """A pose that is pointed at."""

    pose: torch.Tensor  # (4, 4)
    color: Color
    shape: str  # of panels.draw_mark


def draw_belief(
    rgb: Any,
    intrinsics: Any,
    belief: Belief | BeliefBatch,
    object_model: ObjectModel,
    truth: Any = None,
    title: str = "",
    axis: int | None = None,
    draws: int = 0,
) -> np.ndarray:
    """Draw the belief of one image: its rotations on a map, its centers on the photograph, and six
    marginals.

    rgb: one image in any form that `Estimator.predict` takes; intrinsics (3, 3) [px]; belief: a
    result's, whose heaviest mode, or the mean of its draws, is then the estimate, or a filter's
    tensors of one image, with their leading dimension of 1 or without; truth (4, 4); axis: the
    object's axis on the map (its longest, if None); draws: so many of the tensors' first poses are
    a calibrated belief's draws about the estimate. Raises UserError where one is not as it should
    be.
    """
    rgb, K = to_picture(rgb), to_camera(intrinsics)
    poses, weights, best = select_single(belief)
    draws = belief.draws if isinstance(belief, Belief) else draws
    true = None if truth is None else torch.from_numpy(to_pose(truth))
    axis = find_longest_axis(object_model) if axis is None else axis
    summary = summarize_belief(poses, weights, best, object_model, draws)
    sure, other = describe_belief(summary)
    marks = [Mark(best, ESTIMATE, "square"), *([] if true is None else [Mark(true, TRUTH, "ring")])]
    entries = [("estimate", ESTIMATE), *([] if true is None else [("truth", TRUTH)])]
    if summary.second is not None:
        marks.append(Mark(torch.from_numpy(summary.second.pose).double(), _SECOND, "diamond"))
        entries.append(("second pose", _SECOND))
    half, axis_name = tile_width(2), OBJECT_AXES[axis]
    what, colored, scale = describe_samples(weights, draws)
    words = [
        what,
        f"The estimate's mode has {summary.share:.0%} of the belief.",
        f"Map: where the object's {axis_name} axis points; color: the rotation about that axis.",
        f"Photograph: where they put the object's center{colored}.",
        "Below: shares of the belief. Translations are from its mean, rotations from the estimate.",
    ]
    notes = [draw_legend(entries, half), *(draw_text(text, DETAIL, half) for text in words)]
    centers = arrange_grid([draw_centers(poses, weights, marks, object_model, rgb, K, half)], 1)
    return compose_figure(
        title or f"Belief\n{object_model.name}",
        draw_text(sure, CAPTION, bold=True),
        draw_text(other, CAPTION),
        draw_rotations(poses, weights, marks, axis, tile_width(1)),
        draw_turn_scale(),
        arrange_row([centers, np.concatenate(notes)]),
        *scale,
        *draw_marginals(poses, weights, best, true, object_model),
    )


def select_single(belief: Belief | BeliefBatch) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the poses (N, 4, 4), weights (N,) that sum to 1, and estimate (4, 4) of a belief about
    one image.
    """
    if isinstance(belief, Belief):
        poses, weights = torch.from_numpy(belief.samples), torch.from_numpy(belief.weights)
        best, own = torch.from_numpy(belief.modes[0].pose), weights[: belief.draws]
        if belief.draws:
            space = PoseSpace((*belief.center.tolist(),), belief.radius)
            best = space.mean(poses[: belief.draws], own / own.sum())
        return poses, weights, best
    poses, log_weights, best = (
        x.detach().cpu().double() for x in (belief.poses, belief.log_weights, belief.best)
    )
    if poses.ndim == 4:
        if len(poses) != 1:
            raise ValueError(f"expected a belief about one image, got one about {len(poses)}")
        poses, log_weights, best = poses[0], log_weights[0], best[0]
    return poses, torch.softmax(log_weights, 0), best


def describe_samples(weights: torch.Tensor, draws: int) -> tuple[str, str, list[np.ndarray]]:
    """Return what the samples of a belief are, what is added where they are colored by weight, and
    the scale of that, if there is one: draws have equal weights, which tell nothing.
    """
    if not draws:
        ess = float(1 / weights.square().sum())
        what = f"{len(weights)} particles, {ess:.0f} effective."
        return what, ", colored by weight", [draw_weight_scale()]
    others = f", {len(weights) - draws} of other modes" if draws < len(weights) else ""
    return f"{draws} draws of the error model about the estimate{others}.", "", []


def find_longest_axis(object_model: ObjectModel) -> int:
    """Return which of the object's axes its bounding box is longest along; the last of equals."""
    size = (object_model.hull.max(0).values - object_model.hull.min(0).values).tolist()
    return max(range(3), key=lambda i: (round(size[i], 4), i))


def draw_rotations(
    poses: torch.Tensor, weights: torch.Tensor, marks: Sequence[Mark], axis: int, width: int
) -> np.ndarray:
    """Draw rotations on a Mollweide map: place = where the axis points, color = rotation about it,
    area = weight.
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


def scale_radii(
    weights: np.ndarray, min_radius: float = 3.0, max_radius: float = 11.0
) -> np.ndarray:
    """Return radii of discs whose areas grow with weights (N,): `min_radius` at none, `max_radius`
    at the heaviest.  -> (N,) [px].
    """
    share = weights / max(float(weights.max()), 1e-300)
    return np.asarray(np.sqrt(min_radius**2 + (max_radius**2 - min_radius**2) * share))


def draw_centers(
    poses: torch.Tensor,
    weights: torch.Tensor,
    marks: Sequence[Mark],
    object_model: ObjectModel,
    rgb: np.ndarray,
    K: np.ndarray,
    size: int,
) -> np.ndarray:
    """Draw on the photograph where particles put the object's center, cut to the object as the
    first mark has it.
    """
    camera = torch.as_tensor(np.asarray(K), dtype=torch.float64)
    center = object_model.center.cpu().double()
    dots = project(origin_of(poses, center), camera).numpy()
    order = np.argsort(weights.numpy(), kind="stable")
    best = marks[0].pose
    left, top, right = choose_window(
        dots, weights.numpy(), best, object_model, camera.numpy(), *rgb.shape[:2]
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
    object_model: ObjectModel,
    K: np.ndarray,
    height: int,
    width: int,
) -> tuple[float, float, float]:
    """Return the square part of the frame that shows the object as estimated, and 98 % of the
    particles: its left, top and right [px].
    """
    center = origin_of(best, object_model.center.cpu().double())
    middle = project(center[None], torch.as_tensor(K))[0].numpy()
    far = np.abs(dots - middle).max(1)
    order = np.argsort(far)
    last = np.searchsorted(np.cumsum(weights[order]), 0.98).clip(max=len(far) - 1)
    whole = 1.1 * object_model.radius * K[0, 0] / max(float(center[2]), 0.05)
    reach = min(max(whole, float(far[order][last]) * 1.1), max(height, width) / 2)
    u = float(np.clip(middle[0], min(reach, width / 2), max(width - reach, width / 2)))
    v = float(np.clip(middle[1], min(reach, height / 2), max(height - reach, height / 2)))
    return u - reach, v - reach, u + reach


class BeliefSummary(NamedTuple):
    """How sure a belief about one image is."""

    uncertainty: Uncertainty  # at 95 %
    share: float  # weight of the estimate's mode, 0 where the estimate belongs to none
    second: Hypothesis | None  # the heaviest of the other modes, if one counts
    second_translation: float  # how far its center is from the estimate's [m]
    second_rotation: float  # by how much it is turned from the estimate [rad]
    is_outweighed: bool = False  # whether the second is heavier, and the uncertainty about it


def summarize_belief(
    poses: torch.Tensor,
    weights: torch.Tensor,
    best: torch.Tensor,
    object_model: ObjectModel,
    draws: int = 0,
) -> BeliefSummary:
    """Return how sure a belief is; poses that a symmetry makes of one another are one.

    Args:
        poses: Particles (N, 4, 4), camera_from_object [m], float64.
        weights: Their weights (N,), summing to 1.
        best: The estimate (4, 4).
        object_model: The object.
        draws: So many of the first particles are a calibrated belief's draws about the estimate.
    """
    center = object_model.center.detach().cpu().double()
    found = find_hypotheses(poses, weights.log(), best, object_model, draws)
    whole = belief_over(object_model, poses.numpy(), weights.numpy(), draws)
    second = found.others[0] if found.others else None
    away = turned = 0.0
    if second is not None:
        other = torch.from_numpy(second.pose).to(best)
        away = float((origin_of(other, center) - origin_of(best, center)).norm())
        turned = float(angle_between(rotation_of(other), rotation_of(best)))
    share = found.estimate.weight
    outweighed = not draws and second is not None and second.weight > share
    return BeliefSummary(whole.uncertainty(), share, second, away, turned, outweighed)


def describe_belief(summary: BeliefSummary) -> tuple[str, str]:
    """Return how sure a belief is, and what it says of a second pose: two sentences."""
    sure = summary.uncertainty.describe()
    if summary.share == 0:
        sure = f"the estimate lies apart from the particles, which are {sure}"
    elif summary.is_outweighed and summary.second is not None:
        width = replace(summary.uncertainty, mass=1.0).describe()
        own, other = (f"{100 * x:.0f} %" for x in (summary.share, summary.second.weight))
        sure = f"the estimate has {own} of the belief; another pose has {other}, {width}"
    if summary.second is None:
        return sure, "no second pose above 1 %"
    away, turned = format_length(summary.second_translation), math.degrees(summary.second_rotation)
    return sure, f"second pose {100 * summary.second.weight:.0f} %: {away} and {turned:.0f}° off"
