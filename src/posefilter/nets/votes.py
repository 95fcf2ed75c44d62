"""Votes: cells with measured points and likely object points, a few at a time, fix a rigid transform (Kabsch 1976)."""

import torch
from torch import Generator, Tensor

from posefilter.geometry.camera import back_project, pixel_grid
from posefilter.geometry.pose import fit_rigid
from posefilter.nets.coordinates import STRIDE, Cells, Coordinates, pick_fragment

_TOLERANCE = 0.1  # [radii] by which two votes may disagree on how far apart their points are


def measure_cells(depth: Tensor, K: Tensor) -> Cells:
    """Lift each cell's central measured depth to a camera point.  (B, 1, H, W) [m], (B, 3, 3) -> Cells.

    The median of the four central pixels' known depths would mix surfaces at edges; the largest-depth-first pick of one
    pixel does not, so a cell takes the known central pixel nearest to its centre.
    """
    B, _, H, W = depth.shape
    h, w = H // STRIDE, W // STRIDE
    blocks = depth[:, 0, : h * STRIDE, : w * STRIDE].unflatten(1, (h, STRIDE)).unflatten(3, (w, STRIDE))
    center = STRIDE // 2
    choices = [(center - 1, center - 1), (center, center), (center - 1, center), (center, center - 1)]
    z = torch.zeros(B, h, w, dtype=depth.dtype, device=depth.device)
    pixel = pixel_grid(H, W, STRIDE, device=depth.device).expand(B, -1, -1, -1).clone()
    grid0 = pixel_grid(H, W, STRIDE, device=depth.device) - (STRIDE - 1) / 2
    for row, col in choices:
        candidate = blocks[:, :, row, :, col]
        take = (z == 0) & (candidate > 0)
        z = torch.where(take, candidate, z)
        offset = torch.tensor([col, row], dtype=depth.dtype, device=depth.device)
        pixel = torch.where(take[..., None], grid0 + offset, pixel)
    point = back_project(pixel.flatten(1, 2), z.flatten(1), K).unflatten(1, (h, w))
    return Cells(point, z > 0)


def draw_poses(
    said: Coordinates, cells: Cells, center: Tensor, radius: float, count: int, generator: Generator, votes: int = 3
) -> Tensor:
    """Draw poses from the cells' votes.  -> (B, count, 4, 4) camera_from_object [m].

    A seed cell is drawn by p(object) x its surest fragment's share, and one of its fragments by their shares; `votes` more
    cells likewise within 2 radii of it, their fragments by shares x agreement: a rigid object keeps distances, so a part as
    far from the seed's as the measured points are apart is likelier. Their weighted Kabsch fit is one pose. Where no cell of
    an image has a known depth the poses mean nothing.
    """
    B = len(said.logit)
    share, place = said.log_share.exp().flatten(1, 2), said.place.flatten(1, 2)
    weight = ((torch.sigmoid(said.logit).flatten(1) + 1e-4) * share.amax(-1)) * cells.valid.flatten(1)
    weight = torch.where((weight > 0).any(1, keepdim=True), weight, torch.ones_like(weight))
    point = cells.point.flatten(1, 2)
    seed = torch.multinomial(weight, count, replacement=True, generator=generator)
    at = _rows(point, seed)
    near = torch.cdist(at, point) < 2 * radius
    local = weight[:, None] * near + 1e-12 * (weight[:, None] > 0)
    rest = torch.multinomial(local.flatten(0, 1), votes, replacement=True, generator=generator).unflatten(0, (B, count))
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
