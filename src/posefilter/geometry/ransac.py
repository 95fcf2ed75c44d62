"""Rigid poses from 3-D to 3-D correspondences, many of which are wrong.

RANSAC (Fischler and Bolles 1981): poses are fitted to three correspondences each (Kabsch 1976,
Umeyama 1991), a pose's score is the share of the correspondences that agree with it, and it is
fitted again to those that do (Chum, Matas and Kittler 2003).
"""

import torch
from torch import Generator, Tensor

from posefilter.geometry.pose import fit_rigid, transform


def draw_minimal_fits(
    source: Tensor, target: Tensor, weights: Tensor, count: int, generator: Generator
) -> Tensor:
    """Draw poses by rigid fits to three different correspondences each.

    Args:
        source: (B, n, 3) object points [m], n of 3 or more.
        target: (B, n, 3) the camera points that correspond to them [m].
        weights: (B, n) >= 0, by which correspondences are drawn; where fewer than three of an
            image are positive, others are drawn as well.
        count: Number of poses, N.
        generator: Source of randomness.

    Returns:
        camera_from_object (B, N, 4, 4) [m]; arbitrary where the three points are on a line.
    """
    B = len(source)
    chances = (weights + 1e-9)[:, None].expand(-1, count, -1).flatten(0, 1)
    index = torch.multinomial(chances, 3, generator=generator).unflatten(0, (B, count))
    images = torch.arange(B, device=source.device)[:, None, None]
    return fit_rigid(source[images, index], target[images, index], torch.ones_like(index) * 1.0)


def agreement(poses: Tensor, source: Tensor, target: Tensor, tolerance: float) -> Tensor:
    """Return which correspondences agree with which pose.

    (B, N, 4, 4), (B, n, 3) x 2 [m] -> (B, N, n) bool: their distance is below `tolerance` [m].
    """
    placed = transform(poses, source[:, None])
    return (placed - target[:, None]).square().sum(-1) < tolerance**2


def weigh_inliers(inside: Tensor, weights: Tensor, few: float = 0.5) -> Tensor:
    """Return the share of each pose's inliers in the weight of all correspondences.

    Args:
        inside: (B, N, n) bool.
        weights: (B, n) >= 0.
        few: Weight that is added to that of all, so that an image with hardly any correspondence
            gives no pose a high share.

    Returns:
        (B, N) in [0, 1).
    """
    total = weights.sum(1, keepdim=True) + few
    return (inside.to(weights.dtype) @ weights[..., None])[..., 0] / total


def refit_to_inliers(
    poses: Tensor, source: Tensor, target: Tensor, weights: Tensor, tolerance: float, rounds: int
) -> Tensor:
    """Fit poses anew to their inliers, where they do not lose any share of them by it.

    Args:
        poses: (B, N, 4, 4) camera_from_object [m].
        source: (B, n, 3) object points [m].
        target: (B, n, 3) camera points [m].
        weights: (B, n) >= 0.
        tolerance: Distance below which a correspondence is an inlier [m].
        rounds: How often they are fitted.

    Returns:
        (B, N, 4, 4) [m].
    """
    inside = agreement(poses, source, target, tolerance)
    for _ in range(rounds):
        fitted = fit_rigid(source[:, None], target[:, None], inside * weights[:, None])
        now = agreement(fitted, source, target, tolerance)
        better = weigh_inliers(now, weights) >= weigh_inliers(inside, weights)
        better &= inside.sum(-1) >= 3
        poses = torch.where(better[..., None, None], fitted, poses)
        inside = torch.where(better[..., None], now, inside)
    return poses
