"""Poses that the cells of a proposal network vote for."""

import torch
from torch import Generator, Tensor

from posefilter.geometry.camera import back_project, pixel_grid
from posefilter.geometry.votes import draw_votes
from posefilter.nets.coordinates import STRIDE, Cells, Coordinates, whole_cells


def measure_cells(depth: Tensor, K: Tensor) -> Cells:
    """Lift each cell's central measured depth to a camera point.  (B, 1, H, W) [m], (B, 3, 3) ->
    Cells.

    The median of the four central pixels' known depths would mix surfaces at edges; the
    largest-depth-first pick of one pixel does not, so a cell takes the known central pixel nearest
    to its center.
    """
    depth = whole_cells(depth)
    B, _, H, W = depth.shape
    h, w = H // STRIDE, W // STRIDE
    blocks = depth[:, 0].unflatten(1, (h, STRIDE)).unflatten(3, (w, STRIDE))
    center = STRIDE // 2
    choices = [
        (center - 1, center - 1),
        (center, center),
        (center - 1, center),
        (center, center - 1),
    ]
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
    coordinates: Coordinates,
    cells: Cells,
    center: Tensor,
    radius: float,
    count: int,
    generator: Generator,
    votes: int = 3,
) -> Tensor:
    """Draw poses from cells' votes, each believed as far as it is the object.  -> (B, count, 4, 4)
    camera_from_object [m].

    Where no cell of an image has a known depth the poses mean nothing.
    """
    share, position = coordinates.log_share.exp().flatten(1, 2), coordinates.position.flatten(1, 2)
    weight = (torch.sigmoid(coordinates.logit).flatten(1) + 1e-4) * cells.valid.flatten(1)
    return draw_votes(
        cells.point.flatten(1, 2), weight, share, position, center, radius, count, generator, votes
    )
