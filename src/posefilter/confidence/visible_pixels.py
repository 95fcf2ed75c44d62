"""On which pixels an object is seen at a pose, and an image without them."""

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from posefilter.geometry.camera import back_project, pixel_grid, project
from posefilter.geometry.pose import invert, transform
from posefilter.geometry.rotation import fibonacci_sphere
from posefilter.types import Batch, ObjectModel

_NOISE, _SHARE = 0.004, 0.02  # [m] of the depth; of the diameter
_NEAREST = 0.01  # [m] points before the camera's plane
_DIRECTIONS = 256
_RIM = 3  # [px] about hidden pixels


def find_visible(
    poses: Tensor, object_model: ObjectModel, depth: Tensor, intrinsics: Tensor
) -> Tensor:
    """Return the pixels on which an object is seen at poses.

    A pixel whose measured point lies within the object's convex hull shows the object; one that
    lies before or behind it does not.  Of pixels without depth, those count that the hull covers.

    Args:
        poses: (R, 4, 4) camera_from_object [m].
        object_model: The object.
        depth: (H, W) [m], 0 where unknown.
        intrinsics: (3, 3) [px].

    Returns:
        (R, H, W) bool.
    """
    H, W = depth.shape
    grid = pixel_grid(H, W, device=depth.device).reshape(-1, 2)
    points = back_project(grid, depth.flatten(), intrinsics)
    tolerance = _NOISE + _SHARE * object_model.diameter
    known = depth.flatten() > 0
    out = torch.zeros(len(poses), H * W, dtype=torch.bool, device=depth.device)
    for row, pose in enumerate(poses):
        local = transform(invert(pose), points) - object_model.center.to(points)
        near = (known & (local.norm(dim=-1) < object_model.radius + tolerance)).nonzero()[:, 0]
        out[row, near] = lie_in_hull(local[near], object_model, tolerance)
        covered = _cover(pose, object_model, intrinsics, H, W)
        out[row] |= ~known & torch.from_numpy(covered).to(known).flatten()
    return out.unflatten(1, (H, W))


def lie_in_hull(points: Tensor, object_model: ObjectModel, tolerance: float = 0.0) -> Tensor:
    """Tell which points lie in an object's convex hull.

    The hull is bounded by its tangent planes along the mesh's axes and in 256 more directions, so
    that slanted edges are blunt by a few per cent of the diameter.

    Args:
        points: (P, 3) object points, from the object's center [m].
        object_model: The object.
        tolerance: By which a point may lie outside [m].

    Returns:
        (P,) bool.
    """
    directions = _spread_directions(_DIRECTIONS).to(points)
    hull = (object_model.hull.to(points) - object_model.center.to(points)) @ directions.T
    return (points @ directions.T <= hull.amax(0) + tolerance).all(-1)


def blank(batch: Batch, hidden: Tensor) -> Batch:
    """Return images without what some pixels show: in the mean color of the rest, at no known
    depth.

    Args:
        batch: B images.
        hidden: (B, H, W) bool; so are the pixels up to 3 beside them, where edges are blurred.
    """
    wide = F.max_pool2d(hidden[:, None].float(), 2 * _RIM + 1, 1, _RIM) > 0
    rest = (~wide).to(batch.rgb)
    mean = (batch.rgb * rest).sum((2, 3), keepdim=True)
    mean = mean / rest.sum((2, 3), keepdim=True).clamp_min(1)
    rgb = torch.where(wide, mean, batch.rgb)
    return batch._replace(rgb=rgb, depth=batch.depth * ~wide)


def _spread_directions(count: int) -> Tensor:
    """Return unit vectors (count + 6, 3): a Fibonacci lattice, and the axes both ways."""
    axes = np.eye(3)
    return torch.from_numpy(np.concatenate([fibonacci_sphere(count), axes, -axes]))


def _cover(
    pose: Tensor, object_model: ObjectModel, intrinsics: Tensor, height: int, width: int
) -> np.ndarray:
    """Return the pixels (H, W) bool within the outline of the hull; none where it reaches behind
    the camera.
    """
    out = np.zeros((height, width), np.uint8)
    camera = transform(pose, object_model.hull.to(pose))
    if bool((camera[:, 2] > _NEAREST).all()):
        pixels = project(camera, intrinsics).clamp(-1e4, 1e4).double().cpu().numpy()
        outline = cv2.convexHull(pixels.astype(np.float32)).round().astype(np.int32)
        cv2.fillConvexPoly(out, outline, 1)
    return out.astype(bool)
