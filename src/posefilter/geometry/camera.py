"""Pinhole cameras.

Axes: x right, y down, z forward (OpenCV).  A pixel's center has integer coordinates (u, v).
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from posefilter.errors import UserError

_SKEW = 0.003  # in focal lengths: it is not used, and moves points by less than a pixel then


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Tensor:
    """Return the camera matrix [px].  -> (3, 3)."""
    return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def find_matrix_flaw(K: np.ndarray) -> str:
    """Return why finite intrinsics (3, 3) [px] are no pinhole camera's, "" where they are."""
    if not np.allclose(K[2], [0, 0, 1], atol=1e-6):
        hint = "transposed?" if np.allclose(K[:, 2], [0, 0, 1], atol=1e-6) else "not [0, 0, 1]"
        return f"last row {K[2].tolist()}: {hint}"
    if min(K[0, 0], K[1, 1]) <= 0 or abs(K[1, 0]) > 1e-6 * K[1, 1]:
        return f"fx {K[0, 0]:g}, fy {K[1, 1]:g} [px]"
    return f"skew {K[0, 1]:g} px" if abs(K[0, 1]) > _SKEW * K[0, 0] else ""


def check_camera_matrix(intrinsics: Any) -> np.ndarray:
    """Return a camera matrix as float64 (3, 3) [px].

    Raises:
        UserError: It is none.
    """
    try:
        K = np.asarray(intrinsics, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise UserError(f"intrinsics: are no numbers ({error})") from error
    if K.shape != (3, 3):
        raise UserError(f"intrinsics: have shape {K.shape}; expected a camera matrix (3, 3)")
    flaw = find_matrix_flaw(K) if np.isfinite(K).all() else "they hold NaN or infinity"
    if flaw:
        raise UserError(f"intrinsics: are no camera matrix ({flaw})")
    return K


def project(points: Tensor, K: Tensor) -> Tensor:
    """Project camera points to pixels.  (*, P, 3) [m], (*, 3, 3) [px] -> (*, P, 2) [px] as (u, v).

    Points less than 1 mm in front of the camera's plane, or behind it, are projected as if at 1 mm;
    test z where that matters.
    """
    z = points[..., 2:].clamp_min(1e-3)
    focal = torch.stack([K[..., 0, 0], K[..., 1, 1]], -1)[..., None, :]
    center = K[..., :2, 2][..., None, :]
    return points[..., :2] / z * focal + center


def rays(pixels: Tensor, K: Tensor) -> Tensor:
    """Return viewing rays with z = 1.  (*, P, 2) [px], (*, 3, 3) [px] -> (*, P, 3)."""
    focal = torch.stack([K[..., 0, 0], K[..., 1, 1]], -1)[..., None, :]
    center = K[..., :2, 2][..., None, :]
    return torch.cat([(pixels - center) / focal, torch.ones_like(pixels[..., :1])], dim=-1)


def back_project(pixels: Tensor, depth: Tensor, K: Tensor) -> Tensor:
    """Lift pixels to camera points.

    (*, P, 2) [px], (*, P) z-depth [m], (*, 3, 3) [px] -> (*, P, 3) [m].
    """
    return rays(pixels, K) * depth[..., None]


def pixel_grid(
    height: int, width: int, stride: int = 1, device: torch.device | None = None
) -> Tensor:
    """Return the pixel at the center of each stride x stride cell.

    -> (height // stride, width // stride, 2) [px].
    """
    offset = (stride - 1) / 2
    v = torch.arange(height // stride, device=device) * stride + offset
    u = torch.arange(width // stride, device=device) * stride + offset
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)


def resize_intrinsics(K: Tensor, scale_x: float, scale_y: float) -> Tensor:
    """Return the camera matrix of an image resized by (scale_x, scale_y).

    (*, 3, 3) [px]; pixel centers are at integers.
    """
    out = K.clone()
    out[..., 0, :] *= scale_x
    out[..., 1, :] *= scale_y
    out[..., 0, 2] += (scale_x - 1) / 2
    out[..., 1, 2] += (scale_y - 1) / 2
    return out
