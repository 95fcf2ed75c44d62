"""Pose hypotheses from minimal sets of 3-D to 3-D correspondences, by Kabsch's fit (1976)."""

import torch
from torch import Generator, Tensor

from posefilter.geometry.fragments import gather_fragment
from posefilter.geometry.pose import fit_rigid

_TOLERANCE = 0.1  # [radii] by which two votes may disagree on how far distance their points are


def draw_votes(
    point: Tensor,
    weight: Tensor,
    share: Tensor,
    position: Tensor,
    center: Tensor,
    radius: float,
    count: int,
    generator: Generator,
    votes: int = 3,
) -> Tensor:
    """Draw poses by rigid fits to a few correspondences each (RANSAC, Fischler and Bolles 1981).

    A seed point is drawn by weight x the probability of its most probable fragment, and one of its
    fragments by probability. `votes` more points are drawn likewise within 2 radii of it, their
    fragments by probability x agreement: rigid motion keeps distances, so a fragment is likely if
    its distance to the seed's is that of the measured points. The poses of an image whose weights
    are all 0 are arbitrary.

    Args:
        point: (B, n, 3) measured points in the camera [m].
        weight: (B, n) >= 0; 0 where nothing was measured.
        share: (B, n, K) probability of each fragment.
        position: (B, n, K, 3) object point in each fragment, from the object's center, in radii.
        center: (3,) the object's center [m].
        radius: The object's radius [m].
        count: Number of poses.
        generator: Source of randomness.
        votes: Points of a fit, besides the seed.

    Returns:
        Poses (B, count, 4, 4), camera_from_object [m].
    """
    B = len(point)
    weight = weight * share.amax(-1)
    weight = torch.where((weight > 0).any(1, keepdim=True), weight, torch.ones_like(weight))
    seed = torch.multinomial(weight, count, replacement=True, generator=generator)
    seed_point = _rows(point, seed)
    near = torch.cdist(seed_point, point) < 2 * radius
    local = weight[:, None] * near + 1e-12 * (weight[:, None] > 0)
    rest = torch.multinomial(
        local.flatten(0, 1), votes, replacement=True, generator=generator
    ).unflatten(0, (B, count))
    first = gather_fragment(_rows(position, seed), _draw(_rows(share, seed), generator))
    distance = (_rows(point, rest) - seed_point[:, :, None]).norm(dim=-1) / radius
    options = _rows(position, rest)  # (B, count, votes, K, 3)
    misfit = ((options - first[:, :, None, None]).norm(dim=-1) - distance[..., None]) / _TOLERANCE
    agreeing = _rows(share, rest) * (torch.exp(-0.5 * misfit.square()) + 1e-6)
    others = gather_fragment(options, _draw(agreeing, generator))
    index = torch.cat([seed[..., None], rest], dim=-1)
    object_points = torch.cat([first[:, :, None], others], dim=2) * radius + center
    return fit_rigid(object_points, _rows(point, index), _rows(weight[..., None], index)[..., 0])


def _rows(x: Tensor, index: Tensor) -> Tensor:
    """Return rows of a table for each image.  (B, n, *S), (B, *I) int64 -> (B, *I, *S)."""
    images = torch.arange(len(x), device=x.device).view(-1, *[1] * (index.dim() - 1))
    return x[images, index]


def _draw(weights: Tensor, generator: Generator) -> Tensor:
    """Draw one of K options by weights (*, K).  -> (*) int64."""
    flat = weights.flatten(0, -2) + 1e-30
    return torch.multinomial(flat, 1, generator=generator)[:, 0].unflatten(0, weights.shape[:-1])
