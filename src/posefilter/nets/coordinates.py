"""Dense object coordinates: for each cell of an image, is it the object, and which point of it?

The point is predicted by a classification of surface fragments and a regression of the position in
each, as in EPOS (Hodan et al. 2020). Regression alone averages over ambiguous points, and the mean
lies inside the object. A distribution over fragments keeps several modes.
"""

from typing import ClassVar, NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from posefilter.capabilities import Capabilities
from posefilter.geometry.fragments import (
    fragment_errors,
    gather_fragment,
    nearest_fragment,
    within_bounds,
)
from posefilter.geometry.lookup import gather_rows
from posefilter.types import Batch, ObjectModel, Trace

STRIDE = 8  # pixels a cell
CENTRAL = STRIDE // 2 - 1  # [px] from its corner, the first of its four central pixels


class Coordinates(NamedTuple):
    """Output of the coordinate network for h x w cells, K fragments each."""

    logit: Tensor  # (B, h, w) logit of membership of the object
    log_prob: Tensor  # (B, h, w, K) log-probability of each fragment, given that it is the object
    # (B, h, w, K, 3) the object point in each fragment, from the object's center, in radii
    position: Tensor
    centers: Tensor  # (B, K, 3) the fragments' centers, likewise
    features: Tensor  # (B, h, w, C) for a likelihood with context; C = 0 without

    @property
    def coordinate(self) -> Tensor:
        """Return the most probable object point of each cell, from the center, in radii, (B, h, w,
        3).
        """
        return gather_fragment(self.position, self.log_prob.argmax(-1))

    def detach(self) -> "Coordinates":
        """Return the same without gradient."""
        return Coordinates(*(x.detach() for x in self))


class Cells(NamedTuple):
    """The measured point of each cell."""

    point: Tensor  # (B, h, w, 3) camera point [m]
    valid: Tensor  # (B, h, w) bool: depth is known there
    pixel: Tensor  # (B, h, w, 2) that it was lifted from, of images of whole cells [px]


def whole_cells(image: Tensor) -> Tensor:
    """Pad images with zeros to whole cells of `STRIDE` pixels.  (B, C, H, W) -> (B, C, H', W')."""
    H, W = image.shape[-2:]
    return F.pad(image, (0, -W % STRIDE, 0, -H % STRIDE))


def gather_pixels(mask: Tensor, cells: Cells) -> Tensor:
    """Return of each cell whether the pixel whose depth was taken is in a mask.

    Args:
        mask: (B, H, W) bool, of the images or of whole cells.
        cells: Measured points.

    Returns:
        (B, h, w) bool.
    """
    mask = whole_cells(mask)
    u, v = cells.pixel.long().flatten(1, 2).unbind(-1)
    return mask.flatten(1).gather(1, v * mask.shape[-1] + u).view_as(cells.valid)


def true_coordinates(
    cells: Cells, mask: Tensor, camera_from_object: Tensor, center: Tensor, radius: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the targets of the coordinate network.

    Args:
        cells: Measured points.
        mask: (B, 1, H, W) bool.
        camera_from_object: (B, 4, 4) [m].
        center: (3,) the object's center [m].
        radius: The object's radius [m].

    Returns:
        The object point of each cell (B, h, w, 3), from the center, in radii; whether the cell's
        central pixel is on the object (B, h, w) bool; and whether, too, so is the pixel whose depth
        was taken (`measure_cells`), bool: at the object's rim the next one may show what lies
        behind it.
    """
    mask = whole_cells(mask)[:, 0]
    on = mask[:, CENTRAL::STRIDE, CENTRAL::STRIDE]
    lifted = gather_pixels(mask, cells)
    R, t = camera_from_object[:, None, :3, :3], camera_from_object[:, None, None, :3, 3]
    truth = ((cells.point - t) @ R - center) / radius
    return truth, on, on & lifted & cells.valid & within_bounds(truth)


def coordinate_loss(
    coordinates: Coordinates,
    cells: Cells,
    mask: Tensor,
    camera_from_object: Tensor,
    center: Tensor,
    radius: float,
    mean_radius: float,
) -> tuple[Tensor, Tensor]:
    """Return the loss of the coordinate network.

    5 x binary cross-entropy of object membership; on the object with valid depth also the
    cross-entropy of the fragments, and 0.3 x the L1 error of the position in the true fragment, in
    units of the fragments' radius.

    Args:
        coordinates: The network's output.
        cells: Measured points.
        mask: (B, 1, H, W) bool.
        camera_from_object: (B, 4, 4) [m].
        center: (3,) the object's center [m].
        radius: The object's radius [m].
        mean_radius: The fragments' mean radius, in radii of the object.

    Returns:
        The loss of each image (B,), and the mean error of the most probable points (B,) [m], NaN of
        an image in which no cell shows the object with its depth.
    """
    truth, on, usable = true_coordinates(cells, mask, camera_from_object, center, radius)
    inside = usable.float()
    count = inside.sum((1, 2)).clamp_min(1.0)
    mean = lambda x: (x * inside).sum((1, 2)) / count  # noqa: E731
    bce = F.binary_cross_entropy_with_logits(coordinates.logit, on.float(), reduction="none")
    nll, error = fragment_errors(
        coordinates.log_prob, coordinates.position, coordinates.centers, mean_radius, truth
    )
    distance = (coordinates.coordinate - truth).norm(dim=-1).detach() * radius
    seen = usable.flatten(1).any(1)
    return 5 * bce.mean((1, 2)) + mean(nll + 0.3 * error), torch.where(
        seen, mean(distance), torch.nan
    )


class HasCoordinates(Protocol):
    """An encoded image with dense object coordinates."""

    @property
    def coordinates(self) -> Coordinates:
        """The network's output."""

    @property
    def cells(self) -> Cells:
        """What was measured."""

    @property
    def mean_radius(self) -> Tensor:
        """() the fragments' mean radius, in radii of the object."""


class CoordinateLoss:
    """`coordinate_loss` as the loss of a method that learns nothing else."""

    requires: ClassVar[Capabilities] = ("correspondences",)

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return the loss of each image, (B,); the trace's encoding is `HasCoordinates`."""
        encoding: HasCoordinates = trace.encoding
        center, mean_radius = object_model.center.to(batch.depth), float(encoding.mean_radius)
        size, pose = (center, object_model.radius, mean_radius), batch.camera_from_object
        return coordinate_loss(encoding.coordinates, encoding.cells, batch.mask, pose, *size)[0]


class Context(NamedTuple):
    """The coordinate network's output, flattened for gathering."""

    smooth: Tensor  # (B, H / 2 * W / 2, 1 + C) logit and features, interpolated
    share: Tensor  # (B, h * w * K)
    position: Tensor  # (B, h * w * K, 3)
    centers: Tensor  # (B, K, 3)
    grid: tuple[int, int]  # h, w
    columns: int  # W / 2


def flatten_context(coordinates: Coordinates, height: int, width: int) -> Context:
    """Flatten the output of H x W images for gathering.

    Gradients flow to the features only: the rest is trained by `coordinate_loss`.
    """
    rows, columns = -(-height // 2), -(-width // 2)
    grid = torch.cat([coordinates.logit.detach()[..., None], coordinates.features], dim=-1)
    grid = F.interpolate(
        grid.permute(0, 3, 1, 2), scale_factor=STRIDE // 2, mode="bilinear", align_corners=False
    )
    smooth = grid[..., :rows, :columns].flatten(2).transpose(1, 2).contiguous()
    share = coordinates.log_prob.detach().exp().flatten(1)
    position = coordinates.position.detach().flatten(1, 3)
    shape = (coordinates.logit.shape[1], coordinates.logit.shape[2])
    return Context(smooth, share, position, coordinates.centers, shape, columns)


def query(context: Context, u: Tensor, v: Tensor, position: Tensor) -> Tensor:
    """Sample the coordinate network's output at pixels, for the object points of a hypothesis.

    Cells are interpolated bilinearly, positions weighted by the probability of the fragment.

    Args:
        context: The network's output.
        u: (B, *) [px].
        v: (B, *) [px].
        position: (B, *, 3) object points of the hypothesis, from the center, in radii.

    Returns:
        (B, *, 5 + C): log-probability of the point's fragment, predicted position in it (3), logit
        of membership, features.
    """
    h, w = context.grid
    K = context.centers.shape[1]
    with torch.no_grad():
        fragment = nearest_fragment(position, context.centers).flatten(1)
    x = ((u.flatten(1) + 0.5) / STRIDE - 0.5).clamp(0, w - 1)
    y = ((v.flatten(1) + 0.5) / STRIDE - 0.5).clamp(0, h - 1)
    left, top = x.floor(), y.floor()
    total, predicted = torch.zeros_like(x), torch.zeros(*x.shape, 3, dtype=x.dtype, device=x.device)
    for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        near = (1 - (x - left - right).abs()) * (1 - (y - top - down).abs())
        column, row = (left + right).clamp_max(w - 1).long(), (top + down).clamp_max(h - 1).long()
        index = (row * w + column) * K + fragment
        part = near * context.share.gather(1, index) + 1e-12
        total = total + part
        predicted = predicted + part[..., None] * gather_rows(context.position, index)
    at = (v.flatten(1).long() // 2) * context.columns + u.flatten(1).long() // 2
    smooth = gather_rows(context.smooth, at)
    out = torch.cat(
        [total.clamp_min(1e-6).log()[..., None], predicted / total[..., None], smooth], dim=-1
    )
    return out.unflatten(1, u.shape[1:])
