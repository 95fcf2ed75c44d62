"""Bounding boxes as (left, top, right, bottom) [px]: the outer edges, so that one pixel is a box of
area 1.

An object's box is the whole object's, hidden parts too, as far as it lies in the frame. Metrics and
losses share this page, so that a box is taught as it is judged.
"""

import torch
from torch import Tensor

from posefilter.geometry.camera import project
from posefilter.geometry.pose import transform


def box_of_pose(poses: Tensor, points: Tensor, K: Tensor, height: int, width: int) -> Tensor:
    """Return the box of the whole object's outline, hidden parts too, within the frame; zeros where
    none of it is in it.

    (*, 4, 4) camera_from_object, (P, 3) hull or surface points [m], (*, 3, 3) -> (*, 4) [px].
    """
    placed = transform(poses, points.to(poses))
    pixels = project(placed, K)
    frame = pixels.new_tensor([width - 0.5, height - 0.5])
    low = pixels.amin(-2).clamp_min(-0.5)
    high = torch.minimum(pixels.amax(-2), frame)
    seen = (high > low).all(-1, keepdim=True) & (placed[..., 2] > 0).any(-1, keepdim=True)
    return torch.cat([low, high], dim=-1) * seen


def box_iou(a: Tensor, b: Tensor) -> Tensor:
    """Return the Jaccard index of box pairs, 0 where both are empty.

    (*, 4) x 2 [px] -> (*) in [0, 1].
    """
    area = lambda x: (x[..., 2] - x[..., 0]).clamp_min(0) * (x[..., 3] - x[..., 1]).clamp_min(0)  # noqa: E731
    common = area(
        torch.cat(
            [torch.maximum(a[..., :2], b[..., :2]), torch.minimum(a[..., 2:], b[..., 2:])], dim=-1
        )
    )
    union = area(a) + area(b) - common
    return torch.where(union > 0, common / union.clamp_min(1e-12), torch.zeros_like(union))
