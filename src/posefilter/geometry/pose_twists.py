"""Twists between all pairs of two sets of poses, by quaternions."""

from typing import NamedTuple

import torch
from torch import Tensor

from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.geometry.rotation import quat_xyzw_from_matrix


class TwistParts(NamedTuple):
    """Poses, as what twists between them are made of."""

    center: Tensor  # (N, 3) position of the object's center [m]
    quaternion: Tensor  # (N, 4), x, y, z, w

    def select(self, index: Tensor) -> "TwistParts":
        """Return some of the poses."""
        return TwistParts(self.center[index], self.quaternion[index])


def split_poses(poses: Tensor, center: Tensor) -> TwistParts:
    """Return what twists between poses are made of.  (N, 4, 4), (3,) [m] -> N."""
    return TwistParts(origin_of(poses, center), quat_xyzw_from_matrix(rotation_of(poses)))


def pair_twists(start: TwistParts, end: TwistParts) -> Tensor:
    """Return the twists that move N poses to M others, as `twist_between` does.  -> (N, M, 6)."""
    shift = end.center[None] - start.center[:, None]
    a, b = start.quaternion[:, None], end.quaternion[None]
    va, vb, wa, wb = a[..., :3], b[..., :3], a[..., 3:], b[..., 3:]
    vector = wa * vb - wb * va - torch.linalg.cross(*torch.broadcast_tensors(va, vb))
    w = wa * wb + (va * vb).sum(-1, keepdim=True)
    sine = vector.norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, w.abs())
    scale = torch.where(sine > 1e-9, angle / sine.clamp_min(1e-9), torch.full_like(sine, 2.0))
    return torch.cat([shift, scale * vector * torch.where(w < 0, -1.0, 1.0)], dim=-1)
