"""A camera's image -> the network's, as part of an exported network: as `images.make_batch` does.

Programs that run what is exported then need neither OpenCV nor our rules of resizing.
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from posefilter.data.resize import SMOOTH, find_neighbors
from posefilter.geometry.camera import resize_intrinsics
from posefilter.images import BEYOND


class Resize(nn.Module):
    """Resize color, depth and camera of one image.

    Args:
        before: Height and width of the camera's image [px].
        after: Height and width of the network's image [px].
    """

    def __init__(self, before: tuple[int, int], after: tuple[int, int]) -> None:
        super().__init__()
        self.before, self.after = before, after
        whole = all(old % new == 0 for old, new in zip(before, after, strict=True))
        self.kernel = tuple(old // new for old, new in zip(before, after, strict=True))
        self.pools = whole and self.kernel[0] == self.kernel[1]
        shrinks = after[1] <= before[1]
        for name, old, new in zip(("rows", "columns"), before, after, strict=True):
            weights = area_weights(old, new) if shrinks else linear_weights(old, new)
            low, fraction = find_neighbors(old, new)
            self.register_buffer(f"{name}_weight", torch.from_numpy(weights), persistent=False)
            self.register_buffer(f"{name}_low", torch.from_numpy(low), persistent=False)
            self.register_buffer(f"{name}_at", torch.from_numpy(fraction), persistent=False)

    def forward(
        self, rgb: Tensor, depth: Tensor, intrinsics: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Resize.

        Args:
            rgb: (H, W, 3) uint8, RGB.
            depth: (H, W) [m]; unknown where it is 0, not finite, or 100 m and more.
            intrinsics: (3, 3) [px].

        Returns:
            Color (1, 3, h, w) in [0, 1], depth (1, 1, h, w) [m] and camera matrix (1, 3, 3).
        """
        color = rgb.permute(2, 0, 1)[None].float().contiguous()
        z = torch.where((depth > 0) & (depth < BEYOND), depth, torch.zeros_like(depth))
        if self.before == self.after:
            return color / 255, z[None, None], intrinsics[None]
        color = torch.floor(self.resize_color(color) + 0.5) / 255
        scale = [new / old for new, old in zip(self.after, self.before, strict=True)]
        K = resize_intrinsics(intrinsics, scale[1], scale[0])
        return color, self.resize_depth(z)[None, None], K[None]

    def resize_color(self, color: Tensor) -> Tensor:
        """Average over the old pixels of each new one; interpolate where there are more new ones.

        (1, 3, H, W) -> (1, 3, h, w).
        """
        if self.pools:
            return F.avg_pool2d(color, self.kernel)
        rows, columns = self.get_buffer("rows_weight"), self.get_buffer("columns_weight")
        return rows @ color @ columns.T

    def resize_depth(self, z: Tensor) -> Tensor:
        """Interpolate between known neighbors on one surface; else take the nearest.

        (H, W) [m] -> (h, w) [m].
        """
        top, left = self.get_buffer("rows_low"), self.get_buffer("columns_low")
        fy, fx = self.get_buffer("rows_at")[:, None], self.get_buffer("columns_at")[None]
        bottom, right = top + (self.before[0] > 1), left + (self.before[1] > 1)
        upper, lower = z[top], z[bottom]
        a, b, c, d = upper[:, left], upper[:, right], lower[:, left], lower[:, right]
        low = torch.minimum(torch.minimum(a, b), torch.minimum(c, d))
        high = torch.maximum(torch.maximum(a, b), torch.maximum(c, d))
        between = (a * (1 - fx) + b * fx) * (1 - fy) + (c * (1 - fx) + d * fx) * fy
        nearest = torch.where(fy <= 0.5, torch.where(fx <= 0.5, a, b), torch.where(fx <= 0.5, c, d))
        return torch.where((low > 0) & (high - low <= SMOOTH * low), between, nearest)


def area_weights(old: int, new: int) -> np.ndarray:
    """Return the share of each old pixel in each new one.  -> (new, old) float32."""
    edges = np.arange(new + 1) * old / new
    pixel = np.arange(old)
    over = np.minimum(edges[1:, None], pixel + 1) - np.maximum(edges[:-1, None], pixel)
    return (over.clip(0) * new / old).astype(np.float32)


def linear_weights(old: int, new: int) -> np.ndarray:
    """Return the weights of linear interpolation.  -> (new, old) float32."""
    low, fraction = find_neighbors(old, new)
    weights = np.zeros((new, old), np.float32)
    rows = np.arange(new)
    weights[rows, low] = 1 - fraction
    weights[rows, np.minimum(low + 1, old - 1)] += fraction
    return weights
