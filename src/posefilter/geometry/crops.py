"""Crops of RGB-D images about points of space, as a camera sees them that looks at the point.

Such a camera stands where the real one does, turned by the least angle. What it sees of an object
depends on the object's rotation relative to it alone, wherever in the image the object is.
"""

import torch
from torch import Tensor

from posefilter.geometry.camera import project
from posefilter.geometry.lookup import gather_pixels, nearest_pixel, sample
from posefilter.geometry.rotation import hat

CHANNELS = 5  # color, depth, and where it is known
_NEAREST = 0.05  # [m] of a point that is looked at


def look_at(points: Tensor) -> Tensor:
    """Return the rotation of least angle that turns the optical axis to each point.

    (*, 3) [m] -> camera_from_view (*, 3, 3).
    """
    x, y, z = (points / points.norm(dim=-1, keepdim=True).clamp_min(1e-9)).unbind(-1)
    K = hat(torch.stack([-y, x, torch.zeros_like(x)], dim=-1))
    square = K @ K / (1 + z).clamp_min(1e-6)[..., None, None]
    return torch.eye(3, dtype=points.dtype, device=points.device) + K + square


def view_slopes(side: int, device: torch.device | None = None) -> Tensor:
    """Return where the pixels of a view look, in half widths.  -> (side * side, 2) in (-1, 1)."""
    line = (torch.arange(side, device=device) + 0.5) / side * 2 - 1
    return torch.stack(torch.meshgrid(line, line, indexing="xy"), dim=-1).reshape(-1, 2)


def crop_views(
    rgb: Tensor, depth: Tensor, K: Tensor, centers: Tensor, crop_radius: float, side: int
) -> Tensor:
    """Crop images about points, scaled so that a ball of one size about each fills the crop.

    What is measured outside of the ball is left out, as if nothing was there.

    Args:
        rgb: (B, 3, H, W) in [0, 1].
        depth: (B, 1, H, W) z-depth [m], 0 where unknown.
        K: (B, 3, 3) camera matrices [px].
        centers: (B, N, 3) points in the camera [m].
        crop_radius: Radius of the ball [m].
        side: Of a crop [px].

    Returns:
        (B, N, 5, side, side): color in [-1, 1]; depth along the view's axis from the center, in
        radii of the ball; 1 where it is known. All are 0 where nothing is, and where the depth
        alone is unknown only the last two.
    """
    N = centers.shape[1]
    far = centers.norm(dim=-1).clamp_min(_NEAREST)[..., None]  # (B, N, 1)
    slope = view_slopes(side, rgb.device) * (crop_radius / far)[..., None]  # (B, N, P, 2)
    ray = torch.cat([slope, torch.ones_like(slope[..., :1])], dim=-1)
    ray = (ray @ look_at(centers).mT).flatten(1, 2)  # in the camera
    pixels = project(ray, K)
    index = nearest_pixel(pixels)
    ahead = ray[..., 2:] > 1e-3
    z = (gather_pixels(depth, index) / ray[..., 2:].clamp_min(1e-3)).unflatten(1, (N, -1))
    color = (sample(rgb, pixels, padding="border") * 2 - 1).unflatten(1, (N, -1))
    there = ahead.unflatten(1, (N, -1)) & (centers[..., 2:] > 0)[:, :, None]
    seen = gather_pixels(torch.ones_like(depth), index).unflatten(1, (N, -1)) * there
    along = (z[..., 0] - far) / crop_radius
    aside = slope.square().sum(-1) * z[..., 0].square() / crop_radius**2
    known = (z[..., 0] > 0) & (along.square() + aside <= 1) & (seen[..., 0] > 0)
    shown = known | (z[..., 0] == 0) & (seen[..., 0] > 0)
    whole = torch.cat(
        [color * shown[..., None], (along * known)[..., None], known[..., None].to(rgb.dtype)], -1
    )
    return whole.mT.unflatten(-1, (side, side))
