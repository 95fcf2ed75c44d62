"""Surface fragments, as in EPOS (Hodan et al. 2020): Voronoi cells of points on the surface."""

import torch
from torch import Tensor

from posefilter.geometry.lookup import argmin


def gather_fragment(position: Tensor, fragment: Tensor) -> Tensor:
    """Return the positions in given fragments.  (*, K, 3), (*) int64 -> (*, 3)."""
    return position.gather(-2, fragment[..., None, None].expand(*fragment.shape, 1, 3))[..., 0, :]


def nearest_fragment(points: Tensor, centers: Tensor) -> Tensor:
    """Return the fragment that each point belongs to.  (B, *, 3), (B, K, 3) -> (B, *) int64."""
    flat = points.flatten(1, -2)
    farness = centers.square().sum(-1)[:, None] - 2 * flat @ centers.transpose(1, 2)
    return argmin(farness).unflatten(1, points.shape[1:-1])


def sample_farthest_points(points: Tensor, count: int) -> tuple[Tensor, float]:
    """Select points far from each other by farthest point sampling.

    Args:
        points: (P, 3).
        count: Number of points; if it exceeds P, some are selected repeatedly.

    Returns:
        The points (count, 3), and the mean distance of all points to the nearest selected one, in
        the points' unit, at least 0.001.
    """
    distance = (points - points.mean(0)).norm(dim=-1)
    chosen, nearest = [], torch.full_like(distance, torch.inf)
    for _ in range(count):
        index = int(distance.argmax())
        chosen.append(index)
        nearest = torch.minimum(nearest, (points - points[index]).norm(dim=-1))
        distance = nearest
    return points[chosen], max(float(nearest.mean()), 1e-3)


def within_bounds(points: Tensor) -> Tensor:
    """Return which measured points can belong to the object.

    The bounding ball is enlarged by a fifth for the sensor's error. Points farther away lie on the
    background that a mask's pixel can show.

    (*, 3) from the object's center, in radii -> (*) bool.
    """
    return points.norm(dim=-1) < 1.2


def init_fragments(
    centers: Tensor, mean_radius: Tensor, points: Tensor, center: Tensor, radius: float
) -> None:
    """Fill the buffers of fragments from a surface, unless they are filled already.

    Filled buffers are kept, since weights are trained for their fragments.

    Args:
        centers: Buffer (K, 3) for the fragments' centers, from the object's center, in radii.
        mean_radius: Buffer () for the fragments' mean radius, in radii of the object.
        points: (P, 3) surface points [m].
        center: (3,) the object's center [m].
        radius: The object's radius [m].
    """
    if bool(centers.any()):
        return
    middles, mean = sample_farthest_points((points - center) / radius, len(centers))
    centers.copy_(middles)
    mean_radius.fill_(mean)


def fragment_errors(
    log_prob: Tensor, position: Tensor, centers: Tensor, mean_radius: Tensor | float, truth: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the cross-entropy of the true fragments, and the L1 error of the positions in them.

    Args:
        log_prob: (B, *, K) log-probabilities of the fragments.
        position: (B, *, K, 3) predicted position in each fragment.
        centers: (B, K, 3) the fragments' centers.
        mean_radius: The fragments' mean radius, the unit of the L1 error.
        truth: (B, *, 3) true positions; all are from the object's center, in radii.

    Returns:
        Cross-entropies (B, *) [nat] and errors (B, *).
    """
    fragment = nearest_fragment(truth, centers)
    nll = -log_prob.gather(-1, fragment[..., None])[..., 0]
    return nll, (gather_fragment(position, fragment) - truth).abs().sum(-1) / mean_radius
