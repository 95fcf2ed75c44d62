"""Bounding boxes as (left, top, right, bottom) [px]: outer edges, so one pixel is a box of area 1.

An object's box encloses the whole object, hidden parts too, as far as it lies in the frame.
Metrics and losses share these functions, so that training and evaluation use the same box.
"""

import torch
from torch import Tensor

from posefilter.geometry.camera import project
from posefilter.geometry.pose import transform


def box_of_pose(poses: Tensor, points: Tensor, K: Tensor, height: int, width: int) -> Tensor:
    """Return the box of the whole object's outline within the frame.

    Args:
        poses: (*, 4, 4) camera_from_object [m].
        points: (P, 3) hull or surface points [m], object frame.
        K: (*, 3, 3) camera matrices [px].
        height: The frame's height [px].
        width: The frame's width [px].

    Returns:
        Boxes (*, 4) [px]; zeros where the object is out of the frame.
    """
    placed = transform(poses, points.to(poses))
    pixels = project(placed, K)
    frame = pixels.new_tensor([width - 0.5, height - 0.5])
    low = pixels.amin(-2).clamp_min(-0.5)
    high = torch.minimum(pixels.amax(-2), frame)
    visible = (high > low).all(-1, keepdim=True) & (placed[..., 2] > 0).any(-1, keepdim=True)
    return torch.cat([low, high], dim=-1) * visible


def box_iou(a: Tensor, b: Tensor) -> Tensor:
    """Return the intersection over union of pairs of boxes; 0 where both are empty.

    (*, 4) x 2 [px] -> (*) in [0, 1].
    """
    low, high = torch.maximum(a[..., :2], b[..., :2]), torch.minimum(a[..., 2:], b[..., 2:])
    intersection = _area(low, high)
    union = _area(a[..., :2], a[..., 2:]) + _area(b[..., :2], b[..., 2:]) - intersection
    return torch.where(union > 0, intersection / union.clamp_min(1e-12), torch.zeros_like(union))


def _area(low: Tensor, high: Tensor) -> Tensor:
    """Return the area between two corners, 0 where it is empty.  (*, 2) x 2 [px] -> (*)."""
    size = (high - low).clamp_min(0)
    return size[..., 0] * size[..., 1]
