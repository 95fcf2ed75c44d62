"""Metrics of a belief: its uncertainty, and its calibration.

Poses are (B, N, 4, 4) camera_from_object [m], log weights (B, N), normalized.
"""

import torch
from torch import Tensor

from posefilter.geometry.lookup import overlaps_mask
from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.geometry.rotation import angle_between
from posefilter.geometry.spaces import PoseSpace
from posefilter.metrics.errors import add


def entropy(log_weights: Tensor) -> Tensor:
    """Return the entropy of the weights [nat], from 0 (one particle) to log N (equal).  -> (B,)."""
    return -torch.special.xlogy(log_weights.exp(), log_weights.exp()).sum(1)


def spread(poses: Tensor, log_weights: Tensor, space: PoseSpace) -> tuple[Tensor, Tensor]:
    """Return the weighted root mean square distance from the mean pose.

    Returns:
        Of the centers (B,) [m], and of the rotations (B,) [rad].
    """
    center = poses.new_tensor(space.center)
    weights = log_weights.exp()
    mean = space.mean(poses, weights)[:, None]
    shift = (origin_of(poses, center) - origin_of(mean, center)).square().sum(-1)
    turn = angle_between(rotation_of(poses), rotation_of(mean)).square()
    return (weights * shift).sum(1).sqrt(), (weights * turn).sum(1).sqrt()


def mass_within(
    poses: Tensor, log_weights: Tensor, truth: Tensor, points: Tensor, threshold: float
) -> Tensor:
    """Return the weight of the poses whose ADD to the truth is below a threshold.

    Args:
        poses: (B, N, 4, 4).
        log_weights: (B, N).
        truth: (B, 4, 4).
        points: (P, 3) surface points [m].
        threshold: Largest ADD [m].

    Returns:
        Weights (B,) in [0, 1].
    """
    return (log_weights.exp() * (add(poses, truth[:, None], points) < threshold)).sum(1)


def rank_of_truth(
    poses: Tensor, log_weights: Tensor, truth: Tensor, space: PoseSpace, chunk: int = 1 << 20
) -> Tensor:
    """Return the share of the belief that lies deeper in the belief than the truth.

    Depth is the mean distance to the (other) particles. If truths were drawn from the beliefs,
    ranks would be uniform on [0, 1]: a credible region of mass p would contain the truth in a share
    p of the images. Ranks near 1 indicate overconfident or wrong beliefs.

    Args:
        poses: (B, N, 4, 4).
        log_weights: (B, N).
        truth: (B, 4, 4).
        space: The space of the poses.
        chunk: Distances held at once.

    Returns:
        Ranks (B,) in [0, 1].
    """
    weights = log_weights.exp()
    rows = max(1, chunk // log_weights.numel())
    depths = []
    for block, mass in zip(poses.split(rows, dim=1), weights.split(rows, dim=1), strict=True):
        depth = (weights[:, None] * space.distance(block[:, :, None], poses[:, None])).sum(2)
        depths.append(depth / (1 - mass).clamp_min(1e-6))  # of the others alone
    depth_of_truth = (weights * space.distance(truth[:, None], poses)).sum(1, keepdim=True)
    return (weights * (torch.cat(depths, dim=1) < depth_of_truth)).sum(1).clamp(0, 1)


def on_object(mask: Tensor, pixels: Tensor) -> Tensor:
    """Return the share of the particles that are on the mask.

    (B, 1, H, W) bool, (B, N, 2) [px] -> (B,).
    """
    return overlaps_mask(mask, pixels).to(pixels.dtype).mean(1)
