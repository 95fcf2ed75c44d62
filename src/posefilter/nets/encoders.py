"""Image context of a particle: features of the whole image, sampled at the particle's position.

An encoder maps images once to feature maps (a `ContextMap`): color (B, 3, H, W) in [0, 1], depth
(B, 1, H, W) [m] and camera matrices (B, 3, 3) [px]. Each step samples `width` features of these at
each particle.
"""

import math
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.geometry.camera import resize_intrinsics
from posefilter.geometry.lookup import (
    gather_pixels,
    nearest_inside,
    nearest_pixel,
    patch_offsets,
    sample,
)
from posefilter.nets.encoding import UNet, geometry, in_bfloat16, masked_mean_pool, upsample_like
from posefilter.nets.heads import fill_depth
from posefilter.nets.layers import ResBlock


class ContextMap(NamedTuple):
    """Feature maps of one batch of images."""

    levels: tuple[Tensor, ...]  # each (B, F, h, w)
    strides: tuple[int, ...]  # pixels a cell of each
    # (B, h, w) logit of membership of the object, at strides[0]; None without
    objectness: Tensor | None


class NoEncoder(nn.Module):
    """No context, as in the paper: a particle sees its own patch only."""

    width = 0

    def forward(self, rgb: Tensor, depth: Tensor, K: Tensor) -> ContextMap:
        """Return an empty map."""
        return ContextMap((), (), None)

    def sample_features(self, maps: ContextMap, pixels: Tensor) -> Tensor:
        """Return no features.  (B, N, 2) -> (B, N, 0), without gradient.

        With a gradient, the graph behind the positions would be traversed for nothing.
        """
        return pixels.detach()[..., :0]


class PyramidEncoder(nn.Module):
    """Color and depth at halving resolutions, a 3 x 3 patch of each; no learned weights.

    Args:
        levels: Number of resolutions, from 1/2 downwards.

    Raises:
        UserError: `levels` is below 1.
    """

    def __init__(self, levels: int = 5) -> None:
        super().__init__()
        if levels < 1:
            raise UserError(
                f"model.encoder.levels={levels}: must be 1 or more; choose model/encoder=none for "
                "none"
            )
        self.strides = tuple(2 ** (i + 1) for i in range(levels))
        self.width = levels * 9 * 5

    def forward(self, rgb: Tensor, depth: Tensor, K: Tensor) -> ContextMap:
        """Return one map for each level, of 5 channels: color, depth, share of known depth.

        Raises:
            UserError: The image is smaller than a cell of the last level.
        """
        side = min(rgb.shape[-2:])
        if self.strides[-1] > side:
            raise UserError(
                f"model.encoder.levels={len(self.strides)}: a cell of the last would be larger "
                f"than the image; choose {side.bit_length() - 1} or fewer"
            )
        levels = []
        for stride in self.strides:
            z, known = masked_mean_pool(depth, stride)
            levels.append(torch.cat([F.avg_pool2d(rgb, stride) * 2 - 1, z, known], dim=1))
        return ContextMap(tuple(levels), self.strides, None)

    def sample_features(self, maps: ContextMap, pixels: Tensor) -> Tensor:
        """Sample features.  (B, N, 2) [px] -> (B, N, width)."""
        features = []
        for level, stride in zip(maps.levels, maps.strides, strict=True):
            positions = pixels[:, :, None] + patch_offsets(3, pixels.device) * stride
            values = sample(level, positions.flatten(1, 2), stride)
            features.append(values.unflatten(1, positions.shape[1:3]).flatten(2))
        return torch.cat(features, dim=-1)


class FoveatedEncoder(nn.Module):
    """Single pixels about a particle, in square patches of growing spacing, a small convolutional
    network for each; nothing else of the image is read, and no network runs over it.

    It is the retina-like sensor of recurrent attention (Mnih et al. 2014), with two differences:
    coarse patches read single pixels where that sensor averages over blocks, which would read the
    whole image; and spacings are metric, by the depth at the particle, so that a patch covers the
    same part of the object at any distance and in images of any size.

    Args:
        spacings_m: Distance of neighboring pixels of each patch, at the depth of the particle [m].
        size: Pixels along a side of each patch, 5 or more.
        width: Features of a particle.

    Raises:
        UserError: A spacing is not positive, there is none, or `size` is below 5.
    """

    def __init__(
        self,
        spacings_m: Sequence[float] = (0.008, 0.024, 0.072),
        size: int = 7,
        width: int = 128,
    ) -> None:
        super().__init__()
        if not spacings_m or min(spacings_m) <= 0:
            raise UserError(
                f"model.encoder.spacings_m={list(spacings_m)}: each must be positive, and one is "
                "needed; choose model/encoder=none for none"
            )
        if size < 5:
            raise UserError(f"model.encoder.size={size}: must be 5 or more, for two convolutions")
        self.spacings_m, self.size, self.width = tuple(map(float, spacings_m)), size, width
        self.patches = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(5, 32, 3), nn.ReLU(), nn.Conv2d(32, 64, 3), nn.ReLU(), nn.Flatten()
            )
            for _ in spacings_m
        )
        self.join = nn.Linear(len(self.spacings_m) * 64 * (size - 4) ** 2, width)

    def forward(self, rgb: Tensor, depth: Tensor, K: Tensor) -> ContextMap:
        """Return the image itself, color and depth, and with unknown depth filled: depth [m], and
        how many pixels a meter has at it.
        """
        near = fill_depth(depth)
        scale = torch.cat([near, K[:, 0, 0, None, None, None] / near], dim=1)
        return ContextMap((torch.cat([rgb * 2 - 1, depth], dim=1), scale), (1, 1), None)

    def place_patches(self, maps: ContextMap, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Return which pixels are read, and the depth at each particle; a particle off the frame
        has that of the nearest pixel in it.

        (B, N, 2) [px] -> (B, N, S, size * size, 2) int64, (B, N) [m].
        """
        inside = nearest_inside(pixels, *maps.levels[1].shape[-2:])
        depth, scale = gather_pixels(maps.levels[1], inside).unbind(-1)
        # neighbors that are closer than a pixel would be the same one
        spacings = (scale[..., None] * scale.new_tensor(self.spacings_m)).clamp_min(1.0)
        offsets = patch_offsets(self.size, pixels.device) * spacings[..., None, None]
        return nearest_pixel(pixels[:, :, None, None] + offsets), depth

    def sample_features(self, maps: ContextMap, pixels: Tensor) -> Tensor:
        """Compute features, without a gradient of the position.

        (B, N, 2) [px] -> (B, N, width).
        """
        index, depth = self.place_patches(maps, pixels)
        values = gather_pixels(maps.levels[0], index.flatten(1, 3)).unflatten(1, index.shape[1:4])
        color, near = values.split([3, 1], dim=-1)  # zero off the frame
        known = (near > 0).to(near)
        # by the patch's half width, so that a slope looks the same in every patch
        half = near.new_tensor(self.spacings_m)[:, None, None] * (self.size // 2)
        relative = ((near - depth[..., None, None, None]) / half).clamp(-3, 3) * known
        seen = torch.cat([color, relative, known], dim=-1).flatten(0, 1)
        seen = seen.permute(1, 0, 3, 2).unflatten(3, (self.size, self.size))
        with in_bfloat16(color):
            parts = [net(one) for net, one in zip(self.patches, seen, strict=True)]
            joined = self.join(torch.cat(parts, dim=-1))
        return joined.to(color.dtype).unflatten(0, pixels.shape[:2])


class _Encoder(nn.Module):
    """A single feature map, and objectness logits from it by a 1 x 1 convolution."""

    provides: ClassVar[Capabilities] = ("objectness",)

    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width
        self.relevance = nn.Conv2d(width, 1, 1)  # objectness, by its name in checkpoints

    def _map(self, features: Tensor, stride: int) -> ContextMap:
        features = features.float()
        return ContextMap((features,), (stride,), self.relevance(features)[:, 0])

    def sample_features(self, maps: ContextMap, pixels: Tensor) -> Tensor:
        """Sample features.  (B, N, 2) [px] -> (B, N, width); off the frame, those at its edge."""
        return sample(maps.levels[0], pixels, maps.strides[0], padding="border")


def downsample(rgb: Tensor, depth: Tensor, K: Tensor, factor: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return images, depths and cameras at 1 / factor of the size; rows and columns that do not
    fill a cell are left out.

    (B, 3, H, W), (B, 1, H, W) [m], (B, 3, 3) [px] -> the same three. Depth is the mean of what is
    known, 0 where nothing is.
    """
    z, _ = masked_mean_pool(depth, factor)
    return F.avg_pool2d(rgb, factor), z, resize_intrinsics(K, 1 / factor, 1 / factor)


class UNetEncoder(_Encoder, UNet):
    """A small U-Net trained from scratch: strides 4 to 32 and back to 4, about 1.5 million
    parameters.

    It runs in bfloat16 where the hardware supports it (float32 in, float32 out).

    Args:
        widths: Channels at strides 4, 8, 16 and 32, multiples of 8.
        width: Features of a particle.
        max_width_px: Wider images are downsampled by the least integer factor to at most this
            width; None for never.

    Raises:
        UserError: `max_width_px` is below 32.
    """

    def __init__(
        self,
        widths: tuple[int, int, int, int] = (32, 64, 96, 128),
        width: int = 64,
        max_width_px: int | None = None,
    ) -> None:
        super().__init__(width)
        if max_width_px is not None and max_width_px < 32:
            raise UserError(
                f"model.encoder.max_width_px={max_width_px}: must be 32 or more, or null"
            )
        self.max_width_px = max_width_px
        self.build_trunk(widths)
        a, b = widths[:2]
        self.up8 = ResBlock(b)
        self.to4 = nn.Conv2d(b, width, 1)
        self.skip4 = nn.Conv2d(a, width, 1)
        self.up4 = ResBlock(width)

    def forward(self, rgb: Tensor, depth: Tensor, K: Tensor) -> ContextMap:
        """Return one map, of 4 pixels of the downsampled image a cell."""
        factor = 1 if self.max_width_px is None else math.ceil(rgb.shape[-1] / self.max_width_px)
        if factor > 1:
            rgb, depth, K = downsample(rgb, depth, K, factor)
        shape = geometry(depth, K)
        with in_bfloat16(rgb):
            x4, y8 = self.encode(rgb, shape)
            y4 = self.up4(self.skip4(x4) + upsample_like(self.to4(y8), x4))
        return self._map(y4, 4 * factor)


class ResNetEncoder(_Encoder):
    """A ResNet trunk with a top-down path to stride 4 (feature pyramid network, Lin et al. 2017).

    It runs in bfloat16 where the hardware supports it (float32 in, float32 out).

    Args:
        trunk: Maps color in [0, 1] and 7 geometry channels at half resolution to maps of doubling
            strides, of which the first is 4.
        width: Features of a particle.
    """

    def __init__(self, trunk: nn.Module, width: int = 64) -> None:
        super().__init__(width)
        self.trunk = trunk
        channels: tuple[int, ...] = trunk.channels  # type: ignore[assignment]
        self.lateral = nn.ModuleList(nn.Conv2d(c, width, 1) for c in channels)
        self.smooth = ResBlock(width)

    def forward(self, rgb: Tensor, depth: Tensor, K: Tensor) -> ContextMap:
        """Return one map of stride 4."""
        shape = geometry(depth, K)
        with in_bfloat16(rgb):
            maps = self.trunk(rgb.contiguous(memory_format=torch.channels_last), shape)
            top = self.lateral[-1](maps[-1])
            for lateral, low in zip(reversed(self.lateral[:-1]), reversed(maps[:-1]), strict=True):
                top = lateral(low) + upsample_like(top, low)
            top = self.smooth(top)
        return self._map(top, 4)
