"""Losses of displaced particles.

Lengths are in frame widths, so that they do not depend on the image's resolution.
"""

from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from posefilter.capabilities import Capabilities
from posefilter.geometry.boxes import box_iou, box_of_pose
from posefilter.geometry.lookup import mask_pixels, nearest_mask_pixel, patch_offsets
from posefilter.protocols import Label
from posefilter.types import Batch, ObjectModel, Trace


def displaced_positions(trace: Trace) -> Tensor:
    """Return the particles' positions after their displacement, (T, B, N, 2) [px]."""
    return torch.stack(
        [c.state + r.displacement for c, r in zip(trace.particles, trace.outputs, strict=True)]
    )


class Offset:
    """Squared distance of each displaced particle to the nearest mask pixel (the paper, figure 4).

    Mean over all particles and steps. Gradients flow through all steps, so a displacement also
    accounts for its effect on later ones.
    """

    requires: ClassVar[Capabilities] = ("displacement", "pixel_space", "rollout")

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return (B,)."""
        positions = displaced_positions(trace)
        flat = positions.transpose(0, 1).flatten(1, 2)
        offset = (flat - nearest_mask_pixel(batch.mask, flat)) / batch.rgb.shape[-1]
        return offset.square().sum(-1).mean(1)


class Chamfer:
    """Chamfer distance between the displaced particle's patch and the mask (the paper, eq. 5).

    Both are sets of pixel coordinates. The loss is the sum of both directions' mean squared
    distance to the nearest pixel of the other set, averaged over particles and steps. It is
    differentiable in the displacement with fixed correspondences.

    Args:
        size: Side of the patch [px].
        max_pixels: Maximum number of mask pixels, an even selection; None for all.
    """

    requires: ClassVar[Capabilities] = ("displacement", "pixel_space", "rollout")

    def __init__(self, size: int = 9, max_pixels: int | None = 256) -> None:
        self.size = size
        self.max_pixels = max_pixels

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return (B,)."""
        positions = displaced_positions(trace).transpose(0, 1).flatten(1, 2)
        to_mask = self.patch_to_mask(positions, batch.mask)
        to_patch = self.mask_to_patch(positions, batch.mask)
        return (to_mask + to_patch) / batch.rgb.shape[-1] ** 2

    def patch_to_mask(self, positions: Tensor, mask: Tensor) -> Tensor:
        """Return the mean squared distance of each patch pixel to its nearest mask pixel.

        (B, P, 2) [px], (B, 1, H, W) -> (B,) [px^2].
        """
        pixels = (positions[:, :, None] + patch_offsets(self.size, positions.device)).flatten(1, 2)
        return (pixels - nearest_mask_pixel(mask, pixels)).square().sum(-1).mean(1)

    def mask_to_patch(self, positions: Tensor, mask: Tensor) -> Tensor:
        """Return the mean squared distance of each mask pixel to its nearest patch pixel.

        The patch is a grid, so its nearest pixel is found by rounding along each axis.

        (B, P, 2) [px], (B, 1, H, W) -> (B,) [px^2].
        """
        targets, valid = mask_pixels(mask, self.max_pixels)
        offset = targets[:, None] - positions[:, :, None]  # (B, P, M, 2)
        partner = offset.detach().round().clamp(-((self.size - 1) // 2), self.size // 2)
        distance = (offset - partner).square().sum(-1) * valid[:, None]
        return (distance.sum(-1) / valid.sum(1)[:, None].clamp_min(1)).mean(1)


class DirectDisplacement:
    """Huber loss between each step's displacement and its label.

    The label is computed at the particle's current position, so the loss of a step sends no
    gradient to earlier displacements through the label. It can through the features sampled at that
    position, unless model.detach_position=true.

    Args:
        label: Gives the target displacements [px].
        width: Error at which the loss becomes linear, in frame widths.
    """

    requires: ClassVar[Capabilities] = ("displacement", "rollout")

    def __init__(self, label: Label, width: float = 0.05) -> None:
        self.label = label
        self.width = width

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return (B,)."""
        target = self.label(trace, batch, object_model)
        displacement = torch.stack([output.displacement for output in trace.outputs])
        error = (displacement - target) / batch.rgb.shape[-1]
        zero = torch.zeros_like(error)
        loss = F.huber_loss(error, zero, delta=self.width, reduction="none") / self.width
        return loss.sum(-1).mean((0, 2))


class Sides:
    """Loss of the predicted box: L1 of its four sides plus 1 - IoU, over particles on the object.

    The first four numbers of the latent are the distances from the particle to the left, top, right
    and bottom side, in frame widths, as in FCOS (Tian et al. 2019). The true box is that of the
    metric `iou`: the whole object's, hidden parts too, within the frame.

    Args:
        label: Positive for particles on the object.
    """

    requires: ClassVar[Capabilities] = ("free_latent", "pixel_space", "rollout")
    latent_width = 4  # numbers that it teaches

    def __init__(self, label: Label) -> None:
        self.label = label

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return (B,)."""
        height, width = batch.rgb.shape[-2:]
        whole = box_of_pose(
            batch.camera_from_object, object_model.hull, batch.intrinsics, height, width
        )
        box = (whole / width)[:, None]
        on = self.label(trace, batch, object_model) > 0
        total = batch.rgb.new_zeros(len(batch.rgb))
        for particles, output, inside in zip(trace.particles, trace.outputs, on, strict=True):
            position = particles.state.detach() / batch.rgb.shape[-1]
            true = box - position.repeat(1, 1, 2)
            predicted = torch.cat([-output.latent[..., :2], output.latent[..., 2:]], dim=-1)
            loss = (predicted - true).abs().sum(-1) + 1 - box_iou(predicted, true)
            total = total + (loss * inside).sum(1) / inside.sum(1).clamp_min(1)
        return total / len(trace.outputs)
