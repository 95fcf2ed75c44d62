"""The shapes of kernels over poses: covariances of the twists to neighbors, or within a mode.

Twists between all pairs of two sets of poses are computed by quaternions.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.geometry.rotation import quat_xyzw_from_matrix

_SHRINK = 8.0  # poses that the modes' common covariance counts as
_ISOTROPIC = 0.05  # share of a kernel's covariance that has no direction
_WIDEST = 0.6  # [rad] so that five standard deviations end before half a turn
_CHUNK = 1 << 17  # pairs of poses held at once


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


def measure_neighbors(
    parts: TwistParts, weights: Tensor, counts: Sequence[int], unit: Tensor
) -> list[Tensor]:
    """Return the covariances of each pose's twists to its nearest neighbors, itself among them.

    Taken about their mean, and partly without a direction, since neighbors are few.

    Args:
        parts: N poses.
        weights: (N,).
        counts: Numbers of neighbors, rising.
        unit: (6,) that turns twists into meters.

    Returns:
        (N, 6, 6) for each number of neighbors, in m^2: turns times the radius.
    """
    found: list[list[Tensor]] = [[] for _ in counts]
    rows = torch.arange(len(weights), device=weights.device)
    # the weights of far tails are too few to give a shape
    weights = weights + 0.01 * weights.max()
    for some in rows.split(max(1, _CHUNK // len(weights))):
        twist = pair_twists(parts.select(some), parts) * unit
        order = twist.square().sum(-1).argsort(dim=1)
        for number, neighbors in enumerate(counts):
            near = order[:, :neighbors]
            own = twist
            share = weights.expand(len(some), -1)
            if neighbors < len(weights):
                own, share = own.gather(1, near[..., None].expand(-1, -1, 6)), weights[near]
            share = (share / share.sum(1, keepdim=True))[..., None]
            own = own - (share * own).sum(1, keepdim=True)
            found[number].append(_blunt((share * own).mT @ own))
    return [torch.cat(one) for one in found]


def measure_modes(parts: TwistParts, weights: Tensor, member: Tensor, unit: Tensor) -> Tensor:
    """Return the covariance of the twists from the heaviest pose of each pose's mode to its others.

    Taken about their mean.  Of few poses it is partly the mean of all modes' covariances, which
    counts as much as `_SHRINK` poses.

    (N,), (N,), (6,) -> (N, 6, 6) in m^2: turns times the radius.
    """
    # the weights of far tails are too few to give a shape
    weights = weights + 0.01 * weights.max()
    found, counts = [], []
    for mode in range(int(member.max()) + 1):
        own = (member == mode).nonzero()[:, 0]
        if not len(own):
            found.append(weights.new_zeros(6, 6))
            counts.append(0.0)
            continue
        share = weights[own] / weights[own].sum()
        twist = pair_twists(parts.select(own[share.argmax()][None]), parts.select(own))[0] * unit
        twist = twist - share @ twist
        found.append((share[:, None] * twist).mT @ twist)
        counts.append(float(1 / share.square().sum()) - 1)
    each, effective = torch.stack(found), weights.new_tensor(counts)[:, None, None]
    common = (effective * each).sum(0) / effective.sum().clamp_min(1e-9)
    return _blunt((effective * each + _SHRINK * common) / (effective + _SHRINK))[member]


def _blunt(covariance: Tensor) -> Tensor:
    """Return covariances (N, 6, 6) of which a share has no direction, of the same mean variance."""
    size = covariance.diagonal(dim1=1, dim2=2).mean(1)[:, None, None]
    even = _ISOTROPIC * size * torch.eye(6).to(covariance)
    return (1 - _ISOTROPIC) * covariance + even


def whiten_kernels(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Return what maps twists of kernels to standard normal vectors, and the log normalizations.

    Turns are limited to where a Gaussian would wrap round.

    (N, 6, 6) [m^2, m rad, rad^2] -> (N, 6, 6) lower triangular, (N,).
    """
    size, axes = torch.linalg.eigh(covariance[:, 3:, 3:])
    limit = (_WIDEST / size.clamp_min(1e-20).sqrt()).clamp(max=1.0)
    narrow = torch.eye(6).to(covariance).repeat(len(covariance), 1, 1)
    narrow[:, 3:, 3:] = (axes * limit[:, None]) @ axes.mT
    factor = torch.linalg.cholesky(narrow @ covariance @ narrow.mT)
    log_scale = -factor.diagonal(dim1=1, dim2=2).log().sum(1) - 3 * math.log(2 * math.pi)
    eye = torch.eye(6).to(factor).expand_as(factor)
    return torch.linalg.solve_triangular(factor, eye, upper=False), log_scale
