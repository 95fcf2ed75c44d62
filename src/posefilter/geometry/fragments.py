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
    """Choose `count` points far from each other (farthest point sampling).  (P, 3) -> (count, 3),
    their mean reach.

    The reach is the mean distance of all points to the nearest chosen one, in the points' unit, and
    never 0. A set with fewer points gives some of them more than once.
    """
    distance = (points - points.mean(0)).norm(dim=-1)
    chosen, nearest = [], torch.full_like(distance, torch.inf)
    for _ in range(count):
        index = int(distance.argmax())
        chosen.append(index)
        nearest = torch.minimum(nearest, (points - points[index]).norm(dim=-1))
        distance = nearest
    return points[chosen], max(float(nearest.mean()), 1e-3)


def may_be_object(points: Tensor) -> Tensor:
    """Tell which measured points can be of the object.  (*, 3) over the radius, from the object's
    center -> (*) bool.

    A fifth beyond its bounding ball is left to the sensor's error; farther off, a mask's pixel
    shows what lies behind.
    """
    return points.norm(dim=-1) < 1.2


def cut_once(centers: Tensor, reach: Tensor, points: Tensor, center: Tensor, radius: float) -> None:
    """Fill buffers (K, 3) and () by cutting a surface into K fragments, over the radius, from the
    center; once.

    points: (P, 3) of the surface [m]; center: (3,) and radius [m]. Filled buffers stay: what was
    learned is about their fragments, whatever points it is judged by later.
    """
    if bool(centers.any()):
        return
    middles, mean = spread_points((points - center) / radius, len(centers))
    centers.copy_(middles)
    reach.fill_(mean)


def fragment_errors(
    log_share: Tensor, place: Tensor, centers: Tensor, reach: Tensor | float, truth: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the surprise at the true fragments, and the L1 error of the places in them, in units
    of their reach.

    (B, *, K), (B, *, K, 3), (B, K, 3) and the true points (B, *, 3) over the radius, from the
    center -> (B, *), (B, *).
    """
    fragment = nearest_fragment(truth, centers)
    surprise = -log_share.gather(-1, fragment[..., None])[..., 0]
    return surprise, (pick_fragment(place, fragment) - truth).abs().sum(-1) / reach
