"""The predictive distribution: where the particles of the next frame start."""

import torch
from torch import Generator, Tensor

from posefilter.filters.loop import inherit
from posefilter.filters.resample import Multinomial
from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Encoding, Method
from posefilter.tracking.kld import bin_poses, count_needed
from posefilter.tracking.motion import ConstantVelocity
from posefilter.types import Batch, Particles


def draw_predicted(
    belief: Particles,
    drift: Tensor,
    noise_scale: float,
    motion: ConstantVelocity,
    most: int,
    space: PoseSpace,
    generator: Generator,
) -> Tensor:
    """Draw poses from where the object may be now, independently of each other.

    Args:
        belief: Of the frame before, one image.
        drift: (1, 6) expected motion [m, rad].
        noise_scale: Of the motion model's standard deviations.
        motion: Moves poses to the next frame.
        most: Number of draws.
        space: The space of poses.
        generator: Source of randomness.

    Returns:
        Poses (1, most, 4, 4) [m].
    """
    drawn = Multinomial()(belief, most, space, generator)
    return motion(inherit(belief.state, drawn), drift, noise_scale, space, generator)


def take_enough(
    draws: Tensor,
    about: Tensor,
    space: PoseSpace,
    cell: float,
    epsilon: float,
    quantile: float,
    least: int,
) -> Tensor:
    """Return as many of the draws as KLD sampling calls for.

    Args:
        draws: (1, N, 4, 4) independent draws [m].
        about: (4, 4) the middle of the grid [m].
        space: The space of poses.
        cell: Side of the grid's cells [m].
        epsilon: Kullback-Leibler divergence that is allowed [nat].
        quantile: Probability that it stays below.
        least: Number of draws at least.

    Returns:
        The first of the draws, (1, n, 4, 4).
    """
    cells = bin_poses(draws[0], about, space, cell)
    return draws[:, : count_needed(cells, epsilon, quantile, least)]


class FromBelief:
    """Start from given poses, and a few that the method proposes: an `Initialize`.

    With the proposals the filter is never blind to the rest of what the network sees.

    Args:
        poses: (1, N, 4, 4) draws of the predictive distribution [m].
        proposals: Number of poses that the method proposes.
    """

    def __init__(self, poses: Tensor, proposals: int) -> None:
        self.poses, self.proposals = poses, proposals

    def __call__(
        self, batch: Batch, encoding: Encoding, method: Method, particles: int, generator: Generator
    ) -> Tensor:
        """Return (1, N + proposals, 4, 4) [m]."""
        if not self.proposals:
            return self.poses
        proposed = method.propose_poses(encoding, self.proposals, generator)  # type: ignore[attr-defined]
        return torch.cat([self.poses, proposed], dim=1)
