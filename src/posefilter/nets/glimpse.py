"""Glimpses: what a particle sees of the image where it stands.  Outside the frame is zero.

A glimpse of size k covers the offsets -(k - 1) // 2 ... k // 2 about the particle, so that odd and even sizes have the
particle's own pixel among theirs, and both kinds agree wherever the particle stands on whole pixels.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def window(size: int, device: torch.device | None = None) -> Tensor:
    """Return the pixel offsets (u, v) of a glimpse, row by row.  -> (size * size, 2) [px]."""
    side = torch.arange(size, device=device) - (size - 1) // 2
    return torch.stack(torch.meshgrid(side, side, indexing="xy"), dim=-1).reshape(-1, 2)


def nearest_pixel(pixels: Tensor) -> Tensor:
    """Round to whole pixels, halves upwards.  (*, 2) [px] -> (*, 2) int64; far-off particles are capped, not wrapped."""
    return (pixels.detach() + 0.5).floor().clamp(-1e6, 1e6).long()


def pick(image: Tensor, index: Tensor) -> Tensor:
    """Read whole pixels, zero outside the frame.  (B, C, H, W), (B, P, 2) int64 as (u, v) -> (B, P, C)."""
    C, H, W = image.shape[1:]
    u, v = index.unbind(-1)
    inside = (u >= 0) & (u < W) & (v >= 0) & (v < H)
    flat = (v.clamp(0, H - 1) * W + u.clamp(0, W - 1))[:, None].expand(-1, C, -1)
    return (image.flatten(2).gather(2, flat) * inside[:, None]).transpose(1, 2)


def sample(image: Tensor, pixels: Tensor, stride: int = 1, padding: str = "zeros") -> Tensor:
    """Read an image, or a map of `stride` pixels a cell, bilinearly.  (B, C, h, w), (B, P, 2) [px] -> (B, P, C).

    Differentiable in both. Cell i's centre lies at pixel i stride + (stride - 1) / 2. padding: zeros, or border (the edge's
    own values go on for ever).
    """
    h, w = image.shape[-2:]
    cells = (pixels - (stride - 1) / 2) / stride
    scale = pixels.new_tensor([max(w - 1, 1), max(h - 1, 1)])
    grid = (cells / scale * 2 - 1)[:, :, None]
    return F.grid_sample(image, grid, padding_mode=padding, align_corners=True)[..., 0].transpose(1, 2)


class IntegerCut(nn.Module):
    """Cut whole pixels, as one slices an array: nothing of what is seen has a gradient towards where the particle stands."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.size = size

    def forward(self, image: Tensor, pixels: Tensor) -> Tensor:
        """(B, C, H, W), (B, N, 2) [px] -> (B, N, C, size, size)."""
        index = nearest_pixel(pixels)[:, :, None] + window(self.size, pixels.device)
        seen = pick(image, index.flatten(1, 2))
        return seen.unflatten(1, index.shape[1:3]).transpose(2, 3).unflatten(3, (self.size, self.size))


class SmoothGlimpse(nn.Module):
    """Interpolate bilinearly, so that what is seen has a gradient towards where the particle stands.

    spacing: pixels between the glimpse's samples; above 1 the glimpse sees further, more coarsely.
    """

    def __init__(self, size: int, spacing: float = 1.0) -> None:
        super().__init__()
        self.size = size
        self.spacing = spacing

    def forward(self, image: Tensor, pixels: Tensor) -> Tensor:
        """(B, C, H, W), (B, N, 2) [px] -> (B, N, C, size, size)."""
        places = pixels[:, :, None] + window(self.size, pixels.device) * self.spacing
        seen = sample(image, places.flatten(1, 2))
        return seen.unflatten(1, places.shape[1:3]).transpose(2, 3).unflatten(3, (self.size, self.size))
