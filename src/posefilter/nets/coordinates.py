"""Dense object coordinates: for each cell of an image, is it the object, and which point of the
object?

Which point is answered in two parts, a fragment of the surface (a classification) and the place
within it (a regression), after EPOS (Hodan et al. 2020). Regression alone answers doubt by the mean
of what is possible, which lies inside the object and is nobody's point; shares of fragments can
hold several possibilities, so that votes drawn from them do too.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from posefilter.geometry.fragments import (
    fragment_errors,
    gather_fragment,
    nearest_fragment,
    within_bounds,
)

STRIDE = 8  # pixels a cell


class Coordinates(NamedTuple):
    """What a network says of each of the h x w cells, K fragments each."""

    logit: Tensor  # (B, h, w) is it the object
    log_share: Tensor  # (B, h, w, K) log-probability of each fragment, given that it is the object
    # (B, h, w, K, 3) the object's point if it is that fragment, over the radius, from the object's
    # center
    position: Tensor
    centers: Tensor  # (B, K, 3) the fragments' middles, over the radius, from the object's center
    features: Tensor  # (B, h, w, C) told to a likelihood that reads context; C = 0 where none does

    @property
    def coordinate(self) -> Tensor:
        """Return the likeliest object point of each cell, over the radius, from the object's
        center, (B, h, w, 3).
        """
        return gather_fragment(self.position, self.log_share.argmax(-1))

    def first(self, count: int) -> "Coordinates":
        """Return the first so many images."""
        return Coordinates(*(x[:count] for x in self))

    def detach(self) -> "Coordinates":
        """Return the same without gradient."""
        return Coordinates(*(x.detach() for x in self))


class Cells(NamedTuple):
    """The measured side of each cell."""

    point: Tensor  # (B, h, w, 3) camera point [m]
    valid: Tensor  # (B, h, w) bool: depth is known there

    def first(self, count: int) -> "Cells":
        """Return the first so many images."""
        return Cells(*(x[:count] for x in self))


def whole_cells(image: Tensor) -> Tensor:
    """Pad images with zeros to whole cells, as many as the network makes.

    (B, C, H, W) -> the same, sides of `STRIDE`.
    """
    H, W = image.shape[-2:]
    return F.pad(image, (0, -W % STRIDE, 0, -H % STRIDE))


def true_coordinates(
    cells: Cells, mask: Tensor, camera_from_object: Tensor, center: Tensor, radius: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return what a perfect network would say.

    mask: (B, 1, H, W) bool; camera_from_object: (B, 4, 4) [m]. -> the object point that each cell's
    measured point is, over the radius, from the center, (B, h, w, 3); whether the cell's middle
    pixel shows the object, (B, h, w) bool; and whether it also has a depth that can be of the
    object, so that the point is true.
    """
    on = whole_cells(mask)[:, 0, STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
    R, t = camera_from_object[:, None, :3, :3], camera_from_object[:, None, None, :3, 3]
    truth = ((cells.point - t) @ R - center) / radius
    return truth, on, on & cells.valid & within_bounds(truth)


def coordinate_loss(
    coordinates: Coordinates,
    cells: Cells,
    mask: Tensor,
    camera_from_object: Tensor,
    center: Tensor,
    radius: float,
    reach: float,
) -> tuple[Tensor, Tensor]:
    """Return the loss an image (B,) and the mean error of the likeliest coordinates on the object
    (B,) [m].

    5 x binary cross-entropy for `is it the object`, and where it is and depth is known,
    cross-entropy of the fragments and 0.3 x the true one's L1 error in units of their reach
    [radii]. mask: (B, 1, H, W) bool.
    """
    truth, on, usable = true_coordinates(cells, mask, camera_from_object, center, radius)
    inside = usable.float()
    count = inside.sum((1, 2)).clamp_min(1.0)
    mean = lambda x: (x * inside).sum((1, 2)) / count  # noqa: E731
    bce = F.binary_cross_entropy_with_logits(coordinates.logit, on.float(), reduction="none").mean(
        (1, 2)
    )
    surprise, error = fragment_errors(
        coordinates.log_share, coordinates.position, coordinates.centers, reach, truth
    )
    distance = (coordinates.coordinate - truth).norm(dim=-1).detach() * radius
    return 5 * bce + mean(surprise + 0.3 * error), mean(distance)


class Context(NamedTuple):
    """What a network says of images, laid out for gathering."""

    smooth: Tensor  # (B, H / 2 * W / 2, 1 + C) logit and features, interpolated
    share: Tensor  # (B, h * w * K)
    position: Tensor  # (B, h * w * K, 3)
    centers: Tensor  # (B, K, 3)
    grid: tuple[int, int]  # h, w
    columns: int  # W / 2

    def first(self, count: int) -> "Context":
        """Return the first so many images."""
        smooth, share, position, centers = (x[:count] for x in self[:4])
        return Context(smooth, share, position, centers, self.grid, self.columns)


def lay_out_context(coordinates: Coordinates, height: int, width: int) -> Context:
    """Lay out what is coordinates of H x W images.

    Gradients reach the features alone: the rest has a lesson of its own.
    """
    rows, columns = -(-height // 2), -(-width // 2)
    grid = torch.cat([coordinates.logit.detach()[..., None], coordinates.features], dim=-1).permute(
        0, 3, 1, 2
    )
    grid = F.interpolate(grid, scale_factor=STRIDE // 2, mode="bilinear", align_corners=False)[
        ..., :rows, :columns
    ]
    share, position = (
        coordinates.log_share.detach().exp().flatten(1),
        coordinates.position.detach().flatten(1, 3),
    )
    shape = (coordinates.logit.shape[1], coordinates.logit.shape[2])
    return Context(
        grid.flatten(2).transpose(1, 2), share, position, coordinates.centers, shape, columns
    )


def ask(context: Context, u: Tensor, v: Tensor, position: Tensor) -> Tensor:
    """Ask what is coordinates at pixels of the object's points that a hypothesis sees there.

    u, v: (B, *) [px]; position: (B, *, 3) over the radius, from the object's center. -> (B, *, 5 +
    C): log of the share of the fragment that the point lies in, where in it the network sees the
    point, logit, features. Between cells the shares are interpolated, and places by their shares.
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
        predicted = predicted + part[..., None] * context.position.gather(
            1, index[..., None].expand(-1, -1, 3)
        )
    at = (v.flatten(1).long() // 2) * context.columns + u.flatten(1).long() // 2
    smooth = context.smooth.gather(1, at[..., None].expand(-1, -1, context.smooth.shape[-1]))
    out = torch.cat(
        [total.clamp_min(1e-6).log()[..., None], predicted / total[..., None], smooth], dim=-1
    )
    return out.unflatten(1, u.shape[1:])
