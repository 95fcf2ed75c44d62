"""Votes: measured points and likely object points, a few at a time, fix a rigid transform (Kabsch
1976).
"""

import torch
from torch import Generator, Tensor

from posefilter.geometry.fragments import pick_fragment
from posefilter.geometry.pose import fit_rigid

_TOLERANCE = 0.1  # [radii] by which two votes may disagree on how far apart their points are


def draw_votes(
    point: Tensor,
    weight: Tensor,
    share: Tensor,
    place: Tensor,
    center: Tensor,
    radius: float,
    count: int,
    generator: Generator,
    votes: int = 3,
) -> Tensor:
    """Draw poses from what is seen at measured points.  -> (B, count, 4, 4) camera_from_object [m].

    point: (B, n, 3) in the camera [m]; weight: (B, n) >= 0, how much each is believed, 0 where it
    was not measured; share: (B, n, K) of each fragment; place: (B, n, K, 3) the object's point if
    it is that fragment, over the radius, from the center (3,) [m]; radius: [m].

    A seed is drawn by weight x its surest fragment's share, and one of its fragments by their
    shares; `votes` more points likewise within 2 radii of it, their fragments by shares x
    agreement: a rigid object keeps distances, so a part as far from the seed's as the measured
    points are apart is likelier. Their weighted Kabsch fit is one pose. Where all weights of an
    image are 0 the poses mean nothing.
    """
    B = len(point)
    weight = weight * share.amax(-1)
    weight = torch.where((weight > 0).any(1, keepdim=True), weight, torch.ones_like(weight))
    seed = torch.multinomial(weight, count, replacement=True, generator=generator)
    at = _rows(point, seed)
    near = torch.cdist(at, point) < 2 * radius
    local = weight[:, None] * near + 1e-12 * (weight[:, None] > 0)
    rest = torch.multinomial(
        local.flatten(0, 1), votes, replacement=True, generator=generator
    ).unflatten(0, (B, count))
    first = pick_fragment(_rows(place, seed), _draw(_rows(share, seed), generator))
    apart = (_rows(point, rest) - at[:, :, None]).norm(dim=-1) / radius
    options = _rows(place, rest)  # (B, count, votes, K, 3)
    misfit = ((options - first[:, :, None, None]).norm(dim=-1) - apart[..., None]) / _TOLERANCE
    agreeing = _rows(share, rest) * (torch.exp(-0.5 * misfit.square()) + 1e-6)
    others = pick_fragment(options, _draw(agreeing, generator))
    index = torch.cat([seed[..., None], rest], dim=-1)
    things = torch.cat([first[:, :, None], others], dim=2) * radius + center
    return fit_rigid(things, _rows(point, index), _rows(weight[..., None], index)[..., 0])


def _rows(x: Tensor, index: Tensor) -> Tensor:
    """Return rows of a table, image by image.  (B, n, *S), (B, *I) int64 -> (B, *I, *S)."""
    images = torch.arange(len(x), device=x.device).view(-1, *[1] * (index.dim() - 1))
    return x[images, index]


def _draw(weights: Tensor, generator: Generator) -> Tensor:
    """Draw an option by weights (*, K).  -> (*) int64."""
    flat = weights.flatten(0, -2) + 1e-30
    return torch.multinomial(flat, 1, generator=generator)[:, 0].unflatten(0, weights.shape[:-1])
