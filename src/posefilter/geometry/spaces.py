"""The two state spaces of particles: pixels and poses.

A space perturbs, averages and compares states.
"""

from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor

from posefilter import cuda_graphs
from posefilter.geometry import fused_moves
from posefilter.geometry.pose import move_about, origin_of, pose_about, rotation_of
from posefilter.geometry.rotation import angle_between, project_to_so3


@dataclass(frozen=True)
class PixelSpace:
    """States are pixels (2,) [px]."""

    dimensions: ClassVar[int] = 2

    def move(self, state: Tensor, tangent: Tensor) -> Tensor:
        """Return pixels shifted by offsets.  (*, 2), (*, 2) [px] -> (*, 2)."""
        return state + tangent

    def noise_scale(self, sigma: Tensor) -> Tensor:
        """Return the standard deviation along each axis.  (*) -> (*, 2) [px]."""
        return sigma[..., None].expand(*sigma.shape, 2)

    def mean(self, state: Tensor, weights: Tensor) -> Tensor:
        """Return the weighted mean.  (*, N, 2), (*, N) -> (*, 2)."""
        return (weights[..., None] * state).sum(-2)

    def distance(self, a: Tensor, b: Tensor) -> Tensor:
        """Return the Euclidean distance.  (*, 2) x 2 -> (*) [px]."""
        return (a - b).norm(dim=-1)


_find_recording = cuda_graphs.make_recordings()


@cache  # not forgotten: graphs of a GPU read them where they are
def to_device(center: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return a point as a tensor, made once: a GPU is waited for when one is sent to it."""
    return torch.tensor(center, dtype=dtype, device=device)


@dataclass(frozen=True)
class PoseSpace:
    """States are poses (4, 4) camera_from_object, perturbed about the object's center.

    Rotations are measured by the shift that they cause at the object's radius.

    Args:
        center: The object's center in its own frame [m].
        radius: Radius of its bounding sphere [m].
        points: (P, 3) surface points of the object [m], for `axes`.
    """

    center: tuple[float, ...]
    radius: float
    points: Tensor | None = field(default=None, compare=False, repr=False)

    dimensions: ClassVar[int] = 6  # of a tangent vector
    # [rad] of a rotation; a wider Gaussian turn wraps round and covers SO(3) no better
    max_rotation_std: ClassVar[float] = 1.2

    @cached_property
    def axes(self) -> Tensor:
        """The axes of the object's smallest box, or without points of its frame; one a row, (3, 3).

        Found when they are first asked for: few filters turn poses about them.
        """
        if self.points is None:
            return torch.eye(3)
        from posefilter.geometry.axes import box_axes  # a hull in 3-D, slow to import

        return box_axes(self.points).T

    def move(self, state: Tensor, tangent: Tensor) -> Tensor:
        """Return poses shifted, and turned about the object's center, by tangent vectors.

        (*, 4, 4), (*, 6) translation [m] and rotation vector [rad] -> (*, 4, 4).
        """
        if fused_moves.applies(state, tangent):
            return fused_moves.move(state, tangent, self.center)
        center = to_device(self.center, state.dtype, state.device)
        if not cuda_graphs.applies(state, tangent):
            return move_about(state, tangent, center)
        record = _find_recording(cuda_graphs.describe(state, tangent))
        return record(move_about, state, tangent, center)

    def noise_scale(self, sigma: Tensor) -> Tensor:
        """Return the standard deviation along each axis of a perturbation of size sigma [m].

        (*) -> (*, 6) as [m, m, m, rad, rad, rad].
        """
        turn = (sigma / self.radius).clamp(max=self.max_rotation_std)
        return torch.stack([sigma] * 3 + [turn] * 3, dim=-1)

    def mean(self, state: Tensor, weights: Tensor) -> Tensor:
        """Return the weighted mean of the centers, with the chordal mean of the rotations.

        (*, N, 4, 4), (*, N) -> (*, 4, 4).
        """
        c = state.new_tensor(self.center)
        w = weights[..., None]
        center = (w * origin_of(state, c)).sum(-2)
        R = project_to_so3((w[..., None] * rotation_of(state)).sum(-3))
        return pose_about(R, center, c)

    def distance(self, a: Tensor, b: Tensor) -> Tensor:
        """Return the root of the summed squares of shift [m] and angle x radius [m].

        (*, 4, 4) x 2 -> (*) [m].
        """
        c = a.new_tensor(self.center)
        shift = (origin_of(a, c) - origin_of(b, c)).norm(dim=-1)
        turn = angle_between(rotation_of(a), rotation_of(b)) * self.radius
        # so that the gradient at equal poses is 0 and not NaN
        return (shift * shift + turn * turn).clamp_min(1e-30).sqrt()


@dataclass(frozen=True)
class PartsSpace(PoseSpace):
    """Poses of an object as each of its parts sees them: particles come in a block for each part.

    Args:
        parts: Number of parts.
    """

    parts: int = 1

    def split(self, count: int) -> list[slice]:
        """Return which of `count` particles are of each part; some blocks are longer by one where
        the number is no multiple of the parts'.
        """
        ends = [(k * count + self.parts - 1) // self.parts for k in range(self.parts + 1)]
        return [slice(*pair) for pair in pairwise(ends)]
