"""Measures of a belief: how sure it is, and whether it has a right to be.

Poses (B, N, 4, 4), log weights (B, N).
"""

import torch
from torch import Tensor

from posefilter.geometry.lookup import touches
from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.geometry.rotation import angle_between
from posefilter.geometry.spaces import PoseSpace
from posefilter.metrics.errors import add


def entropy(log_weights: Tensor) -> Tensor:
    """Return the entropy of the weights [nat]: 0 where one particle has them all, log N where all
    are alike.  -> (B,).
    """
    return -torch.special.xlogy(log_weights.exp(), log_weights.exp()).sum(1)


def spread(poses: Tensor, log_weights: Tensor, space: PoseSpace) -> tuple[Tensor, Tensor]:
    """Return the weighted root mean square distance from the mean pose: of centers (B,) [m], of
    rotations (B,) [rad].
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
    """Return the share of the weight on poses whose ADD to the truth (B, 4, 4) is below `threshold`
    [m].  -> (B,).
    """
    return (log_weights.exp() * (add(poses, truth[:, None], points) < threshold)).sum(1)


def rank_of_truth(
    poses: Tensor, log_weights: Tensor, truth: Tensor, space: PoseSpace, chunk: int = 1 << 20
) -> Tensor:
    """Return the share of the belief that lies deeper in the belief than the truth does.  (B, 4, 4)
    truth -> (B,) in [0, 1].

    Depth is nearness to all the rest: the mean distance to the (other) particles. Were truths drawn
    from such beliefs, ranks would be uniform on [0, 1], so a credible region of mass p would hold
    the truth in a share p of the images; ranks near 1 tell of beliefs that are too sure, or wrong.
    chunk: distances held at once.
    """
    weights = log_weights.exp()
    rows = max(1, chunk // log_weights.numel())
    parts = []
    for some, own in zip(poses.split(rows, dim=1), weights.split(rows, dim=1), strict=True):
        far = (weights[:, None] * space.distance(some[:, :, None], poses[:, None])).sum(2)
        parts.append(far / (1 - own).clamp_min(1e-6))
    far_truth = (weights * space.distance(truth[:, None], poses)).sum(1, keepdim=True)
    return (weights * (torch.cat(parts, dim=1) < far_truth)).sum(1).clamp(0, 1)


def on_object(mask: Tensor, pixels: Tensor) -> Tensor:
    """Return the share of the particles whose pixel is on the mask.

    (B, 1, H, W) bool, (B, N, 2) [px] -> (B,).
    """
    return touches(mask, pixels).to(pixels.dtype).mean(1)
