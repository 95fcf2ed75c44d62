"""Differentiable pose errors: mean distances of the object's points, for losses and labels."""

import torch
from torch import Tensor

from posefilter.geometry.lookup import argmin
from posefilter.geometry.pose import rotation_of, transform, translation_of


def subsample(points: Tensor, max_points: int) -> Tensor:
    """Return an even selection of at most `max_points` points.  (P, 3) -> (<= most, 3)."""
    if len(points) <= max_points:
        return points
    return points[torch.linspace(0, len(points) - 1, max_points, device=points.device).long()]


def add_distance(poses: Tensor, truth: Tensor, points: Tensor) -> Tensor:
    """Return ADD, the mean distance of corresponding points (the paper, eq. 1).

    (B, N, 4, 4), (B, 4, 4) camera_from_object [m], (P, 3) [m] -> (B, N) [m].
    """
    turn = rotation_of(poses) - rotation_of(truth)[:, None]
    shift = translation_of(poses) - translation_of(truth)[:, None]
    offset = points @ turn.transpose(-1, -2) + shift[..., None, :]
    # the root's slope stays finite at a perfect pose
    return (offset.square().sum(-1) + 1e-12).sqrt().mean(-1)


def add_s_distance(poses: Tensor, truth: Tensor, points: Tensor) -> Tensor:
    """Return ADD-S, the mean distance of each estimated point to the nearest true one (eq. 2).

    (B, N, 4, 4), (B, 4, 4) camera_from_object [m], (P, 3) [m] -> (B, N) [m].
    """
    guess = transform(poses, points)
    true = transform(truth, points)
    with torch.no_grad():
        nearest = argmin(torch.cdist(guess.flatten(1, 2), true))
    partner = true.gather(1, nearest[..., None].expand(-1, -1, 3)).unflatten(1, guess.shape[1:3])
    return ((guess - partner).square().sum(-1) + 1e-12).sqrt().mean(-1)
