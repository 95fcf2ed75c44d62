"""Transition kernels: moving the resampled particles.

`state` (B, N, *S), `displacement` (B, N, D) -> moved states (B, N, *S).
"""

import math
from collections.abc import Iterable
from typing import ClassVar

import torch
from torch import Generator, Tensor

from posefilter.capabilities import Capabilities
from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Propagate, Space
from posefilter.types import Step


class Identity:
    """Leave every particle at its state."""

    provides: ClassVar[Capabilities] = ("recordable",)

    def __call__(
        self, state: Tensor, displacement: Tensor, step: Step, space: Space, generator: Generator
    ) -> Tensor:
        """Return the states unchanged."""
        return state


class Gaussian:
    """Gaussian random walk with standard deviation `noise_scale` x the step's noise level.

    The space defines the standard deviation along each tangent axis.

    Args:
        noise_scale: Standard deviation over the noise level.
    """

    provides: ClassVar[Capabilities] = ("recordable",)

    def __init__(self, noise_scale: float = 0.4) -> None:
        self.noise_scale = noise_scale

    def __call__(
        self, state: Tensor, displacement: Tensor, step: Step, space: Space, generator: Generator
    ) -> Tensor:
        """Return perturbed states."""
        B, N = state.shape[:2]
        scale = space.noise_scale((step.sigma * self.noise_scale).expand(B))[:, None]
        noise = torch.randn(
            B, N, space.dimensions, generator=generator, device=state.device, dtype=state.dtype
        )
        return space.move(state, scale * noise)


class LearnedDisplacement:
    """Move each particle by the displacement that the method's network predicts."""

    provides: ClassVar[Capabilities] = ("recordable",)
    requires: ClassVar[Capabilities] = ("displacement",)

    def __call__(
        self, state: Tensor, displacement: Tensor, step: Step, space: Space, generator: Generator
    ) -> Tensor:
        """Return displaced states, differentiable in the displacement."""
        return space.move(state, displacement)


class HalfTurnRotations:
    """Rotate a share of the poses by pi about a random axis of the object through its center.

    A move between the modes of nearly symmetric objects.

    Args:
        probability: Probability that a particle is rotated.
    """

    provides: ClassVar[Capabilities] = ("recordable",)
    requires: ClassVar[Capabilities] = ("pose_space",)

    def __init__(self, probability: float = 0.1) -> None:
        self.probability = probability

    def __call__(
        self, state: Tensor, displacement: Tensor, step: Step, space: Space, generator: Generator
    ) -> Tensor:
        """Return the states, some rotated."""
        axis = torch.randint(3, state.shape[:2], generator=generator, device=state.device)
        chance = torch.rand(state.shape[:2], generator=generator, device=state.device)
        axes = math.pi * torch.eye(3, dtype=state.dtype, device=state.device)
        turn = axes[axis] * (chance < self.probability)[..., None]
        return space.move(state, torch.cat([torch.zeros_like(turn), turn], dim=-1))


class AxisRotations:
    """Rotate a share of the poses about a random axis of the object's smallest box.

    By pi, or by any angle: a move between the modes of what is nearly symmetric, such as the faces
    of a carton, or a mug whose handle is hidden.

    Args:
        probability: Probability that a particle is rotated.
        uniform_angle_probability: Probability that its angle is uniform rather than pi.
    """

    requires: ClassVar[Capabilities] = ("pose_space",)

    def __init__(self, probability: float = 0.1, uniform_angle_probability: float = 0.5) -> None:
        self.probability = probability
        self.uniform_angle_probability = uniform_angle_probability

    def __call__(
        self, state: Tensor, displacement: Tensor, step: Step, space: Space, generator: Generator
    ) -> Tensor:
        """Return the states, some rotated."""
        assert isinstance(space, PoseSpace)  # of what `requires` says
        size, device = state.shape[:2], state.device
        axis = torch.randint(3, size, generator=generator, device=device)
        moves = torch.rand(size, generator=generator, device=device) < self.probability
        free = torch.rand(size, generator=generator, device=device) < self.uniform_angle_probability
        angle = 2 * math.pi * torch.rand(size, generator=generator, device=device)
        angle = torch.where(free, angle, torch.full_like(angle, math.pi)) * moves
        turn = space.axes.to(state)[axis] * angle[..., None]
        return space.move(state, torch.cat([torch.zeros_like(turn), turn], dim=-1))


class Compose:
    """Apply several kernels one after the other."""

    provides: ClassVar[Capabilities] = ("recordable",)  # if all of them are

    def __init__(self, components: Iterable[Propagate]) -> None:
        self.components = list(components)

    def __call__(
        self, state: Tensor, displacement: Tensor, step: Step, space: Space, generator: Generator
    ) -> Tensor:
        """Return the states that the last kernel leaves."""
        for component in self.components:
            state = component(state, displacement, step, space, generator)
        return state
