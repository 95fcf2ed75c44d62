"""What every encoder of an image starts from: depth as geometry; and how a coarse map joins a finer one."""

import torch
import torch.nn.functional as F
from torch import Tensor

from posefilter.geometry.camera import back_project, pixel_grid, rays


def masked_mean_pool(depth: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Average known depth over size x size blocks.  (B, 1, H, W) [m] -> means (0 where none), share of known pixels."""
    known = (depth > 0).to(depth.dtype)
    share = F.avg_pool2d(known, size)
    return F.avg_pool2d(depth, size) / share.clamp_min(1e-6), share


def normals_from_depth(depth: Tensor, K: Tensor) -> Tensor:
    """Return surface normals towards the camera at half resolution, zeros where depth is missing.

    (B, 1, H, W) [m], (B, 3, 3) -> (B, 3, H // 2, W // 2). Central differences of the points of a 3 x 3 masked mean.
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
    normal = normal * normal.square().sum(1, keepdim=True).clamp_min(1e-24).rsqrt()  # F.normalize is slow across channels
    ok = F.pad(known, (1, 1, 1, 1))
    ok = ok[..., 1:-1, 2:] * ok[..., 1:-1, :-2] * ok[..., 2:, 1:-1] * ok[..., :-2, 1:-1] * known
    return normal * ok


def geometry(depth: Tensor, K: Tensor) -> Tensor:
    """Return normals, depth about 1 m, share of known depth and ray, at half resolution.  (B, 1, H, W) -> (B, 7, ...).

    Channels last: joined with colour that is not, it would have every convolution after it reorder its input.
    """
    B, _, H, W = depth.shape
    z, share = masked_mean_pool(depth, 2)
    grid = pixel_grid(H, W, 2, device=depth.device).reshape(1, -1, 2).expand(B, -1, -1)
    view = rays(grid, K)[..., :2].transpose(1, 2).unflatten(2, z.shape[-2:])
    near = (z - 1.0).clamp(-1.0, 1.5) * (share > 0)
    whole = torch.cat([normals_from_depth(depth, K), near, share, view], dim=1)
    return whole.contiguous(memory_format=torch.channels_last)


def grow(x: Tensor, like: Tensor) -> Tensor:
    """Interpolate a map to the size of another.  (B, C, h, w), (B, *, H, W) -> (B, C, H, W)."""
    return F.interpolate(x, size=like.shape[-2:], mode="bilinear", align_corners=False)
