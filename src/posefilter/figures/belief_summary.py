"""Say in words how sure a belief is, and which other pose it holds for possible."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from posefilter.figures.layout import format_length
from posefilter.figures.view_data import Hypothesis, find_hypotheses
from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.geometry.rotation import angle_between
from posefilter.geometry.spaces import PoseSpace
from posefilter.metrics.beliefs import spread
from posefilter.types import ObjectModel


class BeliefSummary(NamedTuple):
    """How sure a belief about one image is."""

    translation: float  # root mean square distance of the estimate's mode's centers from their mean
    rotation: float  # the same of the rotations [rad]
    share: float  # weight of the estimate's mode, 0 where the estimate belongs to none
    second: Hypothesis | None  # the heaviest of the other modes, if one counts
    second_translation: float  # how far its center is from the estimate's [m]
    second_rotation: float  # by how much it is turned from the estimate [rad]


def summarize_belief(
    poses: Tensor, weights: Tensor, best: Tensor, object_model: ObjectModel, draws: int = 0
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
    space = PoseSpace((*center.tolist(),), object_model.radius)
    members = found.own if bool(found.own.any()) else torch.ones_like(found.own)
    own = torch.where(members, weights, 0.0)
    translation, rotation = spread(found.poses[None], (own / own.sum()).log()[None], space)
    second = found.others[0] if found.others else None
    away = turned = 0.0
    if second is not None:
        other = torch.from_numpy(second.pose).to(best)
        away = float((origin_of(other, center) - origin_of(best, center)).norm())
        turned = float(angle_between(rotation_of(other), rotation_of(best)))
    return BeliefSummary(
        float(translation), float(rotation), found.estimate.weight, second, away, turned
    )


def describe_belief(summary: BeliefSummary) -> tuple[str, str]:
    """Return how sure a belief is, and what it says of a second pose: two sentences."""
    rotation = math.degrees(summary.rotation)
    angle = f"{rotation:.2g}" if rotation < 10 else f"{rotation:.0f}"
    sure = f"sure to ±{format_length(summary.translation)}, ±{angle}°"
    if summary.share == 0:
        sure = "the estimate lies apart from the particles"
    if summary.second is None:
        return sure, "no second pose above 1 %"
    away, turned = format_length(summary.second_translation), math.degrees(summary.second_rotation)
    return sure, f"second pose {100 * summary.second.weight:.0f} %: {away} and {turned:.0f}° off"
