"""Glimpses: what a particle sees of the image where it stands.  Outside the frame is zero.

A glimpse of size k covers the offsets of `geometry.lookup.window`, so that odd and even sizes have
the particle's own pixel among theirs, and both kinds agree wherever the particle stands on whole
pixels.
"""

from torch import Tensor, nn

from posefilter.errors import UserError
from posefilter.geometry.lookup import gather_pixels, nearest_pixel, patch_offsets, sample


class IntegerCut(nn.Module):
    """Cut whole pixels, as one slices an array: nothing of what is seen has a gradient towards
    where the particle stands.
    """

    def __init__(self, size: int) -> None:
        super().__init__()
        if size < 1:
            raise UserError(f"model.glimpse.size={size}: must be 1 pixel or more")
        self.size = size

    def forward(self, image: Tensor, pixels: Tensor) -> Tensor:
        """(B, C, H, W), (B, N, 2) [px] -> (B, N, C, size, size)."""
        index = nearest_pixel(pixels)[:, :, None] + patch_offsets(self.size, pixels.device)
        seen = gather_pixels(image, index.flatten(1, 2))
        return (
            seen.unflatten(1, index.shape[1:3]).transpose(2, 3).unflatten(3, (self.size, self.size))
        )


class SmoothGlimpse(nn.Module):
    """Interpolate bilinearly, so that what is seen has a gradient towards where the particle
    stands.

    spacing: pixels between the glimpse's samples; above 1 the glimpse sees further, more coarsely.
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
        places = pixels[:, :, None] + patch_offsets(self.size, pixels.device) * self.spacing
        seen = sample(image, places.flatten(1, 2))
        return (
            seen.unflatten(1, places.shape[1:3])
            .transpose(2, 3)
            .unflatten(3, (self.size, self.size))
        )
