"""Glimpses: the image patch at each particle.  Outside the frame is zero.

A glimpse of size k covers the offsets of `geometry.lookup.patch_offsets`. Odd and even sizes
include the particle's own pixel. Both kinds agree for particles at whole pixels.
"""

from torch import Tensor, nn

from posefilter.errors import UserError
from posefilter.geometry.lookup import gather_pixels, nearest_pixel, patch_offsets, sample


class IntegerCut(nn.Module):
    """Crop whole pixels; no gradient with respect to the position.

    Args:
        size: Side of the patch [px].
    """

    def __init__(self, size: int) -> None:
        super().__init__()
        if size < 1:
            raise UserError(f"model.glimpse.size={size}: must be 1 pixel or more")
        self.size = size

    def forward(self, image: Tensor, pixels: Tensor) -> Tensor:
        """(B, C, H, W), (B, N, 2) [px] -> (B, N, C, size, size)."""
        index = nearest_pixel(pixels)[:, :, None] + patch_offsets(self.size, pixels.device)
        return _shape_patches(gather_pixels(image, index.flatten(1, 2)), self.size)


class BilinearGlimpse(nn.Module):
    """Sample bilinearly; differentiable in the position.

    Args:
        size: Samples along each side.
        spacing: Pixels between samples.
    """

    def __init__(self, size: int, spacing: float = 1.0) -> None:
        super().__init__()
        if size < 1:
            raise UserError(f"model.glimpse.size={size}: must be 1 pixel or more")
        if spacing <= 0:
            raise UserError(f"model.glimpse.spacing={spacing}: must be above 0")
        self.size = size
        self.spacing = spacing

    def forward(self, image: Tensor, pixels: Tensor) -> Tensor:
        """(B, C, H, W), (B, N, 2) [px] -> (B, N, C, size, size)."""
        positions = pixels[:, :, None] + patch_offsets(self.size, pixels.device) * self.spacing
        return _shape_patches(sample(image, positions.flatten(1, 2)), self.size)


def _shape_patches(values: Tensor, size: int) -> Tensor:
    """(B, N * size * size, C) -> (B, N, C, size, size)."""
    return values.unflatten(1, (-1, size * size)).transpose(2, 3).unflatten(3, (size, size))
