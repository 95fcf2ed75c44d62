"""Pose errors of estimates: ADD and ADD-S, as benchmarks define them."""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from posefilter.geometry.pose import invert, rotation_of, transform, translation_of
from posefilter.geometry.symmetries import list_equivalent

_CHUNK = 1 << 20  # points held at once
_EXACT, _SOME = 16, 256  # equivalent poses that all points measure, and points that choose them


def add(poses: Tensor, truth: Tensor, points: Tensor) -> Tensor:
    """Return ADD, the mean distance of corresponding points (Hinterstoisser et al. 2012).

    (*, 4, 4) camera_from_object twice, leading shapes broadcast, (P, 3) [m] -> (*) [m], in the
    poses' precision.
    """
    lead = torch.broadcast_shapes(poses.shape[:-2], truth.shape[:-2])
    turn = (rotation_of(poses) - rotation_of(truth)).expand(*lead, 3, 3).reshape(-1, 3, 3)
    shift = (translation_of(poses) - translation_of(truth)).expand(*lead, 3).reshape(-1, 3)
    points = points.to(turn)
    rows = max(1, _CHUNK // len(points))
    errors = [
        (points @ R.transpose(-1, -2) + t[:, None]).norm(dim=-1).mean(-1)
        for R, t in zip(turn.split(rows), shift.split(rows), strict=True)
    ]
    return torch.cat(errors).view(lead) if errors else turn.new_zeros(lead)


def add_up_to_symmetry(poses: Tensor, truth: Tensor, points: Tensor, symmetries: Tensor) -> Tensor:
    """Return the least ADD to any of the poses that the object's symmetries make of the truth.

    A continuous symmetry has hundreds of them: the exact error is of the sixteen that are least by
    some of the points. Of a ball it is the distance of the centers.

    Args:
        poses: (B, 4, 4) camera_from_object [m].
        truth: (B, 4, 4).
        points: (P, 3) [m].
        symmetries: (S, 4, 4) object_from_object, the identity among them.

    Returns:
        (B,) [m].
    """
    equal = list_equivalent(poses, truth, symmetries)
    if equal.shape[1] > _EXACT:
        subset = points[:: 1 + len(points) // _SOME]
        _, nearest = add(poses[:, None], equal, subset).topk(_EXACT, dim=1, largest=False)
        equal = equal.gather(1, nearest[..., None, None].expand(-1, -1, 4, 4))
    return add(poses[:, None], equal, points).amin(1)


class NearestPoint:
    """Distances to the nearest of an object's points, by a k-d tree on the CPU."""

    def __init__(self, points: Tensor) -> None:
        self.tree = cKDTree(points.detach().cpu().double().numpy(), leafsize=16)
        # Looked up in the tree's own order, one query's neighbors lie in the cache that the last
        # one has filled.
        self.points = torch.from_numpy(np.ascontiguousarray(self.tree.data[self.tree.indices]))

    def distance(self, queries: Tensor) -> Tensor:
        """Return distances to the nearest point.  (*, 3) float64 on the CPU [m] -> (*) float64
        [m].
        """
        return torch.from_numpy(self.tree.query(queries.numpy(), workers=-1)[0])


def add_s(poses: Tensor, truth: Tensor, points: Tensor | NearestPoint) -> Tensor:
    """Return ADD-S, the mean distance of each *true* point to the nearest *estimated* one.

    This is the direction of the YCB-Video toolbox and of published results; eq. 2 of the paper has
    the other one. True points are mapped into the object frame of the estimate, which keeps
    distances, so one tree serves all poses.

    (*, 4, 4) camera_from_object twice, leading shapes broadcast, (P, 3) [m] -> (*) [m].
    """
    near = points if isinstance(points, NearestPoint) else NearestPoint(points)
    guess_from_true = invert(poses.detach().cpu().double()) @ truth.detach().cpu().double()
    lead = guess_from_true.shape[:-2]
    rows = max(1, _CHUNK // len(near.points))
    errors = [
        near.distance(transform(block, near.points)).mean(-1)
        for block in guess_from_true.reshape(-1, 4, 4).split(rows)
    ]
    return (torch.cat(errors).view(lead) if errors else guess_from_true.new_zeros(lead)).to(poses)
