"""The two spaces that particles live in.

A space knows how to perturb, average and measure its states.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from posefilter.geometry.pose import move_about, origin_of, pose_about, rotation_of
from posefilter.geometry.rotation import angle_between, project_to_so3


@dataclass(frozen=True)
class PixelSpace:
    """Particles are pixels (2,) [px]."""

    dimensions: int = 2

    def move(self, state: Tensor, tangent: Tensor) -> Tensor:
        """Shift pixels.  (*, 2), (*, 2) [px] -> (*, 2)."""
        return state + tangent

    def noise_scale(self, sigma: Tensor) -> Tensor:
        """Return the spread an axis of a move whose size is sigma.  (*) -> (*, 2) [px]."""
        return sigma[..., None].expand(*sigma.shape, 2)

    def mean(self, state: Tensor, weights: Tensor) -> Tensor:
        """Return the weighted mean.  (*, N, 2), (*, N) -> (*, 2)."""
        return (weights[..., None] * state).sum(-2)

    def distance(self, a: Tensor, b: Tensor) -> Tensor:
        """Return the Euclidean distance.  (*, 2) x 2 -> (*) [px]."""
        return (a - b).norm(dim=-1)


@dataclass(frozen=True)
class PoseSpace:
    """Particles are poses (4, 4), perturbed about the object's center; a turn counts as the shift
    it gives at the radius.

    center: the object's center in its own frame [m]; radius: of its bounding sphere [m].
    """

    center: tuple[float, float, float]
    radius: float
    dimensions: int = 6
    max_turn: float = 1.2  # [rad]; a wider Gaussian turn wraps round and covers SO(3) no better

    def move(self, state: Tensor, tangent: Tensor) -> Tensor:
        """Move poses about the object's center.  (*, 4, 4), (*, 6) [m, rad] -> (*, 4, 4)."""
        return move_about(state, tangent, state.new_tensor(self.center))

    def noise_scale(self, sigma: Tensor) -> Tensor:
        """Return the spread an axis of a move whose size is sigma [m].

        (*) -> (*, 6) as [m, m, m, rad, rad, rad].
        """
        turn = (sigma / self.radius).clamp(max=self.max_turn)
        return torch.stack([sigma] * 3 + [turn] * 3, dim=-1)

    def mean(self, state: Tensor, weights: Tensor) -> Tensor:
        """Return the weighted mean: of the centers, and the chordal mean of the rotations.

        (*, N, 4, 4) -> (*, 4, 4).
        """
        c = state.new_tensor(self.center)
        w = weights[..., None]
        center = (w * origin_of(state, c)).sum(-2)
        R = project_to_so3((w[..., None] * rotation_of(state)).sum(-3))
        return pose_about(R, center, c)

    def distance(self, a: Tensor, b: Tensor) -> Tensor:
        """Return shift [m] and turn x radius [m], added in quadrature.

        (*, 4, 4) x 2 -> (*) [m].
        """
        c = a.new_tensor(self.center)
        shift = (origin_of(a, c) - origin_of(b, c)).norm(dim=-1)
        turn = angle_between(rotation_of(a), rotation_of(b)) * self.radius
        return (shift * shift + turn * turn).sqrt()
