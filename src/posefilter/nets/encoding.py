"""Input encoding shared by image encoders: depth as geometry channels, and the U-Net trunk."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from posefilter.geometry.camera import back_project, pixel_grid, rays
from posefilter.nets.folded import ConvNorm
from posefilter.nets.layers import ResBlock, fast_bfloat16


def masked_mean_pool(depth: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Average known depth over size x size blocks.

    (B, 1, H, W) [m] -> means (0 where none), share of known pixels.
    """
    known = (depth > 0).to(depth.dtype)
    share = F.avg_pool2d(known, size)
    return F.avg_pool2d(depth, size) / share.clamp_min(1e-6), share


def normals_from_depth(depth: Tensor, K: Tensor) -> Tensor:
    """Return surface normals towards the camera at half resolution, zeros where depth is missing.

    Central differences of points that are averaged over 3 x 3 known neighbors.

    (B, 1, H, W) [m], (B, 3, 3) [px] -> (B, 3, H // 2, W // 2).
    """
    B, _, H, W = depth.shape
    z, share = masked_mean_pool(depth, 2)
    known = (share > 0).to(z.dtype)
    weight = F.avg_pool2d(known, 3, stride=1, padding=1).clamp_min(1e-6)
    z = F.avg_pool2d(z * known, 3, stride=1, padding=1) / weight * known
    grid = pixel_grid(H, W, 2, device=depth.device).reshape(1, -1, 2).expand(B, -1, -1)
    P = back_project(grid, z.flatten(1), K).transpose(1, 2).unflatten(2, (H // 2, W // 2))
    P = F.pad(P, (1, 1, 1, 1), mode="replicate")
    along_u = P[..., 1:-1, 2:] - P[..., 1:-1, :-2]
    along_v = P[..., 2:, 1:-1] - P[..., :-2, 1:-1]
    normal = torch.linalg.cross(along_v, along_u, dim=1)
    # F.normalize is slow across channels
    normal = normal * normal.square().sum(1, keepdim=True).clamp_min(1e-24).rsqrt()
    ok = F.pad(known, (1, 1, 1, 1))
    ok = ok[..., 1:-1, 2:] * ok[..., 1:-1, :-2] * ok[..., 2:, 1:-1] * ok[..., :-2, 1:-1] * known
    return normal * ok


def geometry(depth: Tensor, K: Tensor) -> Tensor:
    """Return geometry channels at half resolution: normals, depth - 1 m, share of known depth, ray.

    Odd sides are rounded up, as by a convolution of stride 2. The result is in channels-last
    format, so that later convolutions need not reorder their input.

    (B, 1, H, W) [m], (B, 3, 3) [px] -> (B, 7, ceil(H / 2), ceil(W / 2)).
    """
    depth = F.pad(depth, (0, depth.shape[-1] % 2, 0, depth.shape[-2] % 2))
    B, _, H, W = depth.shape
    z, share = masked_mean_pool(depth, 2)
    grid = pixel_grid(H, W, 2, device=depth.device).reshape(1, -1, 2).expand(B, -1, -1)
    view = rays(grid, K)[..., :2].transpose(1, 2).unflatten(2, z.shape[-2:])
    near = (z - 1.0).clamp(-1.0, 1.5) * (share > 0)
    whole = torch.cat([normals_from_depth(depth, K), near, share, view], dim=1)
    return whole.contiguous(memory_format=torch.channels_last)


def upsample_like(x: Tensor, like: Tensor) -> Tensor:
    """Interpolate a map to the size of another.  (B, C, h, w), (B, *, H, W) -> (B, C, H, W).

    Where half of an odd side was rounded up, the map is stretched, by less than a cell of its own.
    """
    return F.interpolate(x, size=like.shape[-2:], mode="bilinear", align_corners=False)


def in_bfloat16(rgb: Tensor) -> torch.autocast:
    """Return the autocast context of image encoders.

    bfloat16 for float32 images where the hardware supports it; otherwise disabled.
    """
    return torch.autocast(
        rgb.device.type,
        torch.bfloat16,
        enabled=rgb.dtype == torch.float32 and fast_bfloat16(rgb.device),
    )


class UNet(nn.Module):
    """Trunk of a U-Net with residual blocks, strides 4 to 32 and back to 8.

    Color enters at full resolution, geometry at half. Subclasses create the layers by
    `build_trunk`, then `up8`: names and order of parameters are those of existing checkpoints and
    optimizer states.
    """

    up8: nn.Module  # of each subclass, laid next: what follows on the way up at stride 8

    def build_trunk(self, widths: tuple[int, int, int, int]) -> None:
        """Create all layers but `up8`.

        Args:
            widths: Channels at strides 4, 8, 16 and 32, multiples of 8.
        """
        a, b, c, d = widths
        self.color = ConvNorm(3, 24, stride=2)
        self.enter = ConvNorm(24 + 7, a, stride=2)
        self.down4 = ResBlock(a)
        self.down8 = nn.Sequential(ConvNorm(a, b, 2), ResBlock(b))
        self.down16 = nn.Sequential(ConvNorm(b, c, 2), ResBlock(c), ResBlock(c))
        self.down32 = nn.Sequential(ConvNorm(c, d, 2), ResBlock(d), ResBlock(d))
        self.to16, self.up16 = nn.Conv2d(d, c, 1), ResBlock(c)
        self.to8 = nn.Conv2d(c, b, 1)

    def encode(self, rgb: Tensor, shape: Tensor) -> tuple[Tensor, Tensor]:
        """Encode images.

        Args:
            rgb: (B, 3, H, W) in [0, 1].
            shape: Its geometry channels at half resolution.

        Returns:
            Maps of stride 4 (from the downward path) and 8 (from the upward path).
        """
        x = self.color((rgb * 2 - 1).contiguous(memory_format=torch.channels_last))
        x4 = self.down4(self.enter(torch.cat([x, shape.to(x.dtype)], dim=1)))
        x8 = self.down8(x4)
        x16 = self.down16(x8)
        x32 = self.down32(x16)
        y16 = self.up16(x16 + upsample_like(self.to16(x32), x16))
        return x4, self.up8(x8 + upsample_like(self.to8(y16), x8))
