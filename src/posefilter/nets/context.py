"""Global context: what a particle may know of the image beyond its own glimpse, sampled where the
particle stands.

Every context maps images, (B, 3, H, W) in [0, 1], (B, 1, H, W) [m] and (B, 3, 3) [px], once to
feature maps (a `ContextMap`), and is then looked up at each particle at each step, for `width`
features.
"""

import math
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.geometry.camera import resize_intrinsics
from posefilter.geometry.lookup import patch_offsets, sample
from posefilter.nets.encoding import UNet, geometry, grow, in_bfloat16, masked_mean_pool
from posefilter.nets.layers import ResBlock


class ContextMap(NamedTuple):
    """Feature maps of one batch of images."""

    levels: tuple[Tensor, ...]  # each (B, F, h, w)
    strides: tuple[int, ...]  # pixels a cell of each
    # (B, h, w) logit of `this cell shows the object`, at strides[0]; None where not told
    relevance: Tensor | None


class NoContext(nn.Module):
    """The paper's choice: a particle knows its own patch, and nothing else."""

    width = 0

    def forward(self, rgb: Tensor, depth: Tensor, K: Tensor) -> ContextMap:
        """Return an empty map."""
        return ContextMap((), (), None)

    def look(self, seen: ContextMap, pixels: Tensor) -> Tensor:
        """(B, N, 2) -> (B, N, 0), without gradient: else all that decided the place would be asked
        for zeros.
        """
        return pixels.detach()[..., :0]


class Pyramid(nn.Module):
    """Color and depth at halving resolutions, a 3 x 3 glimpse of each: a fovea without a single
    learned weight.
    """

    def __init__(self, levels: int = 5) -> None:
        super().__init__()
        if levels < 1:
            raise UserError(
                f"model.encoder.levels={levels}: must be 1 or more; choose model/encoder=none for none"
            )
        self.strides = tuple(2 ** (i + 1) for i in range(levels))
        self.width = levels * 9 * 5

    def forward(self, rgb: Tensor, depth: Tensor, K: Tensor) -> ContextMap:
        """Return one map a level, of 5 channels: color, depth, share of known depth."""
        side = min(rgb.shape[-2:])
        if self.strides[-1] > side:
            raise UserError(
                f"model.encoder.levels={len(self.strides)}: a cell of the last would be larger than the "
                f"image; "
                f"choose {side.bit_length() - 1} or fewer"
            )
        levels = []
        for stride in self.strides:
            z, known = masked_mean_pool(depth, stride)
            levels.append(torch.cat([F.avg_pool2d(rgb, stride) * 2 - 1, z, known], dim=1))
        return ContextMap(tuple(levels), self.strides, None)

    def look(self, seen: ContextMap, pixels: Tensor) -> Tensor:
        """(B, N, 2) [px] -> (B, N, width)."""
        found = []
        for level, stride in zip(seen.levels, seen.strides, strict=True):
            places = pixels[:, :, None] + patch_offsets(3, pixels.device) * stride
            found.append(
                sample(level, places.flatten(1, 2), stride)
                .unflatten(1, places.shape[1:3])
                .flatten(2)
            )
        return torch.cat(found, dim=-1)


class _Encoder(nn.Module):
    """One feature map, and the relevance that a 1 x 1 convolution reads off it."""

    provides: ClassVar[Capabilities] = ("relevance",)

    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width
        self.relevance = nn.Conv2d(width, 1, 1)

    def _map(self, features: Tensor, stride: int) -> ContextMap:
        features = features.float()
        return ContextMap((features,), (stride,), self.relevance(features)[:, 0])

    def look(self, seen: ContextMap, pixels: Tensor) -> Tensor:
        """(B, N, 2) [px] -> (B, N, width); beyond the frame, what lies at its edge."""
        return sample(seen.levels[0], pixels, seen.strides[0], padding="border")


def averaged(rgb: Tensor, depth: Tensor, K: Tensor, factor: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return images, depths and cameras at 1 / factor of the size; rows and columns that do not
    fill a cell are left out.

    (B, 3, H, W), (B, 1, H, W) [m], (B, 3, 3) [px] -> the same three. Depth is the mean of what is
    known, 0 where nothing is.
    """
    z, _ = masked_mean_pool(depth, factor)
    return F.avg_pool2d(rgb, factor), z, resize_intrinsics(K, 1 / factor, 1 / factor)


class ConvEncoder(_Encoder, UNet):
    """A small U-Net from nothing: strides 4 to 32 and back to 4, about a million and a half
    parameters.

    widths: channels at strides 4, 8, 16 and 32, multiples of 8; width: features a particle gets;
    most_px: images that are wider are averaged down to that, by a whole number, since context is
    about the whole (null: never). Runs in bfloat16 where the machine has it (float32 in, float32
    out), which halves its time on processors.
    """

    def __init__(
        self,
        widths: tuple[int, int, int, int] = (32, 64, 96, 128),
        width: int = 64,
        most_px: int | None = None,
    ) -> None:
        super().__init__(width)
        if most_px is not None and most_px < 32:
            raise UserError(f"model.encoder.most_px={most_px}: must be 32 or more, or null")
        self.most_px = most_px
        self.lay_trunk(widths)
        a, b = widths[:2]
        self.up8 = ResBlock(b)
        self.to4, self.skip4, self.up4 = (
            nn.Conv2d(b, width, 1),
            nn.Conv2d(a, width, 1),
            ResBlock(width),
        )

    def forward(self, rgb: Tensor, depth: Tensor, K: Tensor) -> ContextMap:
        """Return one map, of 4 pixels a cell in an image as small as it is looked at."""
        factor = 1 if self.most_px is None else math.ceil(rgb.shape[-1] / self.most_px)
        if factor > 1:
            rgb, depth, K = averaged(rgb, depth, K, factor)
        shape = geometry(depth, K)
        with in_bfloat16(rgb):
            x4, y8 = self.encode(rgb, shape)
            y4 = self.up4(self.skip4(x4) + grow(self.to4(y8), x4))
        return self._map(y4, 4 * factor)


class ResNetContext(_Encoder):
    """A ResNet trunk (its weights from a file, an address, or chance) with a light top-down path to
    stride 4.

    trunk: gives maps of strides 4, 8, 16 and 32 for color in [0, 1] and 7 geometry channels at half
    resolution.
    """

    def __init__(self, trunk: nn.Module, width: int = 64) -> None:
        super().__init__(width)
        self.trunk = trunk
        channels: tuple[int, ...] = trunk.channels  # type: ignore[assignment]
        self.lateral = nn.ModuleList(nn.Conv2d(c, width, 1) for c in channels)
        self.smooth = ResBlock(width)

    def forward(self, rgb: Tensor, depth: Tensor, K: Tensor) -> ContextMap:
        """Return one map of stride 4."""
        maps = self.trunk(rgb, geometry(depth, K))
        top = self.lateral[-1](maps[-1])
        for lateral, low in zip(reversed(self.lateral[:-1]), reversed(maps[:-1]), strict=True):
            top = lateral(low) + grow(top, low)
        return self._map(self.smooth(top), 4)
