"""Chamfer distance between the values, not the places, of a particle's pixels and the object's."""

from typing import ClassVar

import torch
from torch import Tensor

from posefilter.capabilities import Capabilities
from posefilter.geometry.lookup import (
    gather_pixels,
    mask_pixels,
    nearest_pixel,
    patch_offsets,
    sample,
)
from posefilter.losses.displacement import displaced_positions
from posefilter.types import Batch, ObjectModel, Trace


class RgbdChamfer:
    """Chamfer distance between the displaced patch and the object as sets of RGB-D values.

    The paper's eq. 5 compares sets of shape N x 4 and does not say what the four numbers are. Here
    they are a pixel's own: red, green and blue in [0, 1], and depth [m]. The patch is sampled
    bilinearly, zero outside the frame, so that the loss has a gradient with respect to the
    displacement; correspondences are fixed. Mean over particles and steps.

    Args:
        size: Side of the patch [px].
        max_pixels: Maximum number of mask pixels, an even selection; None for all.
        chunk: Distances held at once.
    """

    requires: ClassVar[Capabilities] = ("displacement", "pixel_space", "rollout")

    def __init__(self, size: int = 9, max_pixels: int | None = 256, chunk: int = 1 << 23) -> None:
        self.size, self.max_pixels, self.chunk = size, max_pixels, chunk

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return (B,); 0 where the object is not visible."""
        image = torch.cat([batch.rgb, batch.depth], dim=1)
        pixels, valid = mask_pixels(batch.mask, self.max_pixels)
        target = gather_pixels(image, nearest_pixel(pixels))  # (B, M, 4)
        positions = displaced_positions(trace).transpose(0, 1).flatten(1, 2)
        offsets = patch_offsets(self.size, positions.device)
        places = positions[:, :, None] + offsets  # (B, P, S, 2)
        patch = sample(image, places.flatten(1, 2)).unflatten(1, places.shape[1:3])
        step = max(1, self.chunk // (len(image) * len(offsets) * target.shape[1]))
        distances = [self.distance(part, target, valid) for part in patch.split(step, dim=1)]
        return torch.cat(distances, dim=1).mean(1) * valid.any(1)

    def distance(self, patch: Tensor, target: Tensor, valid: Tensor) -> Tensor:
        """Return the sum of both directions' mean squared distance to the nearest.

        (B, P, S, 4), (B, M, 4), (B, M) bool -> (B, P).
        """
        P, S = patch.shape[1:3]
        flat = patch.flatten(1, 2)
        with torch.no_grad():
            apart = torch.cdist(flat, target).unflatten(1, (P, S))
            apart = apart.masked_fill(~valid[:, None, None], torch.inf)
            to_target, to_patch = apart.argmin(3), apart.argmin(2)  # (B, P, S), (B, P, M)
        nearest_target = target.gather(1, to_target.flatten(1)[..., None].expand(-1, -1, 4))
        patch_to_target = (flat - nearest_target).square().sum(-1).unflatten(1, (P, S)).mean(2)
        nearest_patch = patch.gather(2, to_patch[..., None].expand(-1, -1, -1, 4))
        target_to_patch = (nearest_patch - target[:, None]).square().sum(-1) * valid[:, None]
        return patch_to_target + target_to_patch.sum(2) / valid.sum(1)[:, None].clamp_min(1)
