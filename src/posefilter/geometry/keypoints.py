"""Keypoints of an object's box: where they are in an image, maps of them, and poses from them.

As in DOPE (Tremblay et al. 2018): the eight corners of the bounding box and its center, a Gaussian
in a map of each, and a pose by perspective-n-point (EPnP, Lepetit et al. 2009).
"""

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from posefilter.geometry.camera import pixel_grid, project
from posefilter.geometry.pose import transform
from posefilter.geometry.rigid import rigid

KEYPOINTS = 9
_FEWEST = 4  # of a pose by EPnP
_FARTHEST = 100.0  # [m] of a pose that is one


def box_keypoints(points: Tensor) -> Tensor:
    """Return the corners of the bounding box along the object's axes, and its center.

    (P, 3) -> (9, 3).
    """
    low, high = points.amin(0), points.amax(0)
    sides = torch.tensor([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]).to(points)
    corners = low + sides * (high - low)
    return torch.cat([corners, (low + high)[None] / 2])


def project_keypoints(poses: Tensor, keypoints: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """Return where keypoints are in images, and whether they lie before the camera.

    Args:
        poses: (B, N, 4, 4) camera_from_object [m].
        keypoints: (k, 3) [m].
        K: (B, 3, 3) camera matrices [px].

    Returns:
        (B, N, k, 2) [px], and (B, N, k) bool.
    """
    placed = transform(poses, keypoints.to(poses))
    return project(placed, K[:, None]), placed[..., 2] > 0.01


def draw_gaussians(
    pixels: Tensor, present: Tensor, height: int, width: int, stride: int, sigma: float
) -> Tensor:
    """Draw a map of each keypoint: a Gaussian of height 1 about it.

    Args:
        pixels: (B, k, 2) [px].
        present: (B, k) bool; the maps of others are 0.
        height: Of the maps, in cells.
        width: Of the maps, in cells.
        stride: Pixels of a cell.
        sigma: Standard deviation [cells].

    Returns:
        (B, k, height, width) in [0, 1].
    """
    grid = pixel_grid(height * stride, width * stride, stride, device=pixels.device)
    far = (grid - pixels[:, :, None, None]).square().sum(-1) / (stride * sigma) ** 2
    return torch.exp(-0.5 * far) * present[..., None, None]


def find_peaks(maps: Tensor, count: int, stride: int) -> tuple[Tensor, Tensor]:
    """Find the highest local maxima of each map, between cells.

    A peak's place is that of the parabola through the logarithms of its cell and the next ones
    along each axis, which is exact for a Gaussian; at the frame's edge it is the cell's middle.

    Args:
        maps: (B, k, h, w) >= 0.
        count: Peaks of a map.
        stride: Pixels of a cell.

    Returns:
        Their pixels (B, k, count, 2) [px] and heights (B, k, count); a map with fewer peaks has
        others of height 0.
    """
    h, w = maps.shape[-2:]
    highest = F.max_pool2d(maps, 3, stride=1, padding=1)
    heights, index = (maps * (maps == highest)).flatten(2).topk(count)
    logs = F.pad(maps.clamp_min(1e-6).log(), (1, 1, 1, 1), mode="replicate").flatten(2)
    row, column = index // w, index % w
    middle = (row + 1) * (w + 2) + column + 1
    places = []
    for cell, step, last in ((column, 1, w - 1), (row, w + 2, h - 1)):
        before, at, after = (logs.gather(2, middle + i * step) for i in (-1, 0, 1))
        bend = (2 * at - before - after).clamp_min(1e-6)
        shift = ((after - before) / (2 * bend)).clamp(-0.5, 0.5)
        places.append(cell + shift * ((cell > 0) & (cell < last)))
    return torch.stack(places, dim=-1) * stride + (stride - 1) / 2, heights


def solve_pnp(
    points: np.ndarray, pixels: np.ndarray, K: np.ndarray, tolerance_px: float | None = None
) -> np.ndarray | None:
    """Return the pose that puts object points at pixels, by EPnP.

    Args:
        points: (n, 3) [m], n of 4 or more, not all in a plane.
        pixels: (n, 2) [px].
        K: Camera matrix (3, 3) [px].
        tolerance_px: Distance of an inlier, for OpenCV's RANSAC; None: all points are fitted.

    Returns:
        camera_from_object (4, 4) [m], float64; None where none was found between the camera and
        100 m before it.
    """
    points, pixels, K = (np.ascontiguousarray(a, dtype=np.float64) for a in (points, pixels, K))
    if len(points) < _FEWEST:
        return None
    try:
        if tolerance_px is None:
            found, turn, shift = cv2.solvePnP(points, pixels, K, None, flags=cv2.SOLVEPNP_EPNP)
        else:
            found, turn, shift, _ = cv2.solvePnPRansac(
                points,
                pixels,
                K,
                None,
                reprojectionError=tolerance_px,
                iterationsCount=100,
                flags=cv2.SOLVEPNP_EPNP,
            )
    except cv2.error:  # degenerate points
        return None
    pose = rigid(cv2.Rodrigues(turn)[0], shift[:, 0])
    depth = points @ pose[2, :3] + pose[2, 3]
    sound = found and np.isfinite(pose).all() and depth.min() > 0 and depth.max() < _FARTHEST
    return pose if sound else None
