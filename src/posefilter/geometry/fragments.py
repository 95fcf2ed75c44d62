"""A surface cut into fragments: which of them a point lies in, and where."""

import torch
from torch import Tensor


def pick_fragment(place: Tensor, fragment: Tensor) -> Tensor:
    """Return the places of chosen fragments.  (*, K, 3), (*) int64 -> (*, 3)."""
    return place.gather(-2, fragment[..., None, None].expand(*fragment.shape, 1, 3))[..., 0, :]


def nearest_fragment(points: Tensor, centers: Tensor) -> Tensor:
    """Return which fragment points belong to.  (B, *, 3), (B, K, 3) -> (B, *) int64."""
    flat = points.flatten(1, -2)
    nearness = 2 * flat @ centers.transpose(1, 2) - centers.square().sum(-1)[:, None]
    return nearness.argmax(-1).unflatten(1, points.shape[1:-1])


def spread_points(points: Tensor, count: int) -> tuple[Tensor, float]:
    """Choose `count` points far from each other (farthest point sampling).  (P, 3) -> (count, 3), their mean reach.

    The reach is the mean distance of all points to the nearest chosen one, in the points' unit, and never 0. A set with
    fewer points gives some of them more than once.
    """
    distance = (points - points.mean(0)).norm(dim=-1)
    chosen, nearest = [], torch.full_like(distance, torch.inf)
    for _ in range(count):
        index = int(distance.argmax())
        chosen.append(index)
        nearest = torch.minimum(nearest, (points - points[index]).norm(dim=-1))
        distance = nearest
    return points[chosen], max(float(nearest.mean()), 1e-3)
