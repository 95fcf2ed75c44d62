"""Pose hypotheses from the output of the coordinate network."""

import torch
from torch import Generator, Tensor

from posefilter.geometry.camera import back_project, pixel_grid
from posefilter.geometry.votes import draw_votes
from posefilter.nets.coordinates import CENTRAL, STRIDE, Cells, Coordinates, whole_cells
from posefilter.types import Batch


def measure_cells(depth: Tensor, K: Tensor) -> Cells:
    """Lift one depth pixel of each cell to a camera point.  (B, 1, H, W) [m], (B, 3, 3) -> Cells.

    It is the first known one of the cell's four central pixels. Their median would mix surfaces at
    depth edges.
    """
    depth = whole_cells(depth)
    B, _, H, W = depth.shape
    h, w = H // STRIDE, W // STRIDE
    middle = _list_central(depth)
    z = torch.zeros(B, h, w, dtype=depth.dtype, device=depth.device)
    grid = pixel_grid(H, W, STRIDE, device=depth.device)
    pixel, corner = grid.expand(B, -1, -1, -1), grid - (STRIDE - 1) / 2
    for row, col in ((0, 0), (1, 1), (0, 1), (1, 0)):
        candidate = middle[:, :, row, :, col]
        take = (z == 0) & (candidate > 0)
        z = torch.where(take, candidate, z)
        offset = torch.tensor([col, row], dtype=depth.dtype, device=depth.device) + CENTRAL
        pixel = torch.where(take[..., None], corner + offset, pixel)
    point = back_project(pixel.flatten(1, 2), z.flatten(1), K).unflatten(1, (h, w))
    return Cells(point, z > 0, pixel)


def has_depth(batch: Batch) -> Tensor:
    """Return in which images a pose can be proposed, since a cell has depth.  -> (B,) bool."""
    return (_list_central(whole_cells(batch.depth)) > 0).flatten(1).any(1)


def _list_central(depth: Tensor) -> Tensor:
    """Return the central pixels of whole cells.  (B, 1, H, W) -> (B, h, 2, w, 2)."""
    _, _, H, W = depth.shape
    blocks = depth[:, 0].unflatten(1, (H // STRIDE, STRIDE)).unflatten(3, (W // STRIDE, STRIDE))
    two = slice(CENTRAL, CENTRAL + 2)
    return blocks[:, :, two, :, two]


def draw_poses(
    coordinates: Coordinates,
    cells: Cells,
    center: Tensor,
    radius: float,
    count: int,
    generator: Generator,
    votes: int = 3,
) -> Tensor:
    """Draw poses by rigid fits to a few cells each, weighted by the probability of the object.

    The poses of an image without valid depth are arbitrary.

    Args:
        coordinates: Output of the coordinate network.
        cells: Measured points.
        center: (3,) the object's center [m].
        radius: The object's radius [m].
        count: Number of poses.
        generator: Source of randomness.
        votes: Points of a fit, besides the first.

    Returns:
        Poses (B, count, 4, 4), camera_from_object [m].
    """
    share, position = coordinates.log_prob.exp().flatten(1, 2), coordinates.position.flatten(1, 2)
    weight = (torch.sigmoid(coordinates.logit).flatten(1) + 1e-4) * cells.valid.flatten(1)
    return draw_votes(
        cells.point.flatten(1, 2), weight, share, position, center, radius, count, generator, votes
    )
