"""Betting on one pose of the last cloud.

The belief itself is always the whole cloud with its weights.
"""

import torch
from torch import Generator, Tensor

from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Method, Scene, Space
from posefilter.types import Belief, ParticleOutput, Particles


def picked(particles: Particles, output: ParticleOutput, index: Tensor, score: Tensor) -> Belief:
    """Return the belief that bets on one particle an image.  index, score (B,)."""
    rows = torch.arange(len(index), device=index.device)
    return Belief(output.pose, particles.log_weights, output.pose[rows, index], score)


class Argmax:
    """The pose of the particle with the highest likelihood (the paper, section 5); its
    log-likelihood is the score.
    """

    def __call__(
        self,
        particles: Particles,
        output: ParticleOutput,
        scene: Scene,
        method: Method,
        generator: Generator,
    ) -> Belief:
        """Return the belief."""
        score, index = output.log_likelihood.max(1)
        return picked(particles, output, index, score)


class Mean:
    """The weighted mean of the poses; the score is the weighted mean of the log-likelihoods.

    Poses are averaged about the object's center where the space knows it, else about the frame's
    origin. Between two far-off modes the mean is a pose that nobody voted for: see DensestMode.
    """

    def __call__(
        self,
        particles: Particles,
        output: ParticleOutput,
        scene: Scene,
        method: Method,
        generator: Generator,
    ) -> Belief:
        """Return the belief, differentiable in weights and poses."""
        space = (
            method.space if isinstance(method.space, PoseSpace) else PoseSpace((0.0, 0.0, 0.0), 1.0)
        )
        weights = particles.log_weights.exp()
        likely = torch.where(
            weights > 0, weights * output.log_likelihood, torch.zeros_like(weights)
        )
        return Belief(
            output.pose, particles.log_weights, space.mean(output.pose, weights), likely.sum(1)
        )


def kernel_mass(
    state: Tensor, log_weights: Tensor, space: Space, bandwidth: float, chunk: int = 1 << 22
) -> Tensor:
    """Return the log of the Gaussian-weighted mass round each particle, at most 0.  (B, N, *S), (B,
    N) -> (B, N).

    chunk: distances held at once.
    """
    rows = max(1, chunk // log_weights.numel())
    parts = []
    for some in state.split(rows, dim=1):
        distance = space.distance(some[:, :, None], state[:, None])
        parts.append(
            torch.logsumexp(log_weights[:, None] - 0.5 * (distance / bandwidth).square(), dim=2)
        )
    return torch.cat(parts, dim=1)


class DensestMode:
    """The pose of the particle round which most of the weight lies; the log of that share of it is
    the score.

    bandwidth: of the Gaussian kernel over the particles' states, in the space's unit ([m] or [px]).
    """

    def __init__(self, bandwidth: float) -> None:
        self.bandwidth = bandwidth

    def __call__(
        self,
        particles: Particles,
        output: ParticleOutput,
        scene: Scene,
        method: Method,
        generator: Generator,
    ) -> Belief:
        """Return the belief."""
        mass = kernel_mass(
            particles.state.detach(), particles.log_weights.detach(), method.space, self.bandwidth
        )
        score, index = mass.max(1)
        return picked(particles, output, index, score)


class DensestPose:
    """The pose on which most of the weight agrees, whatever the particles are: pixels can vote for
    one pose from afar.

    bandwidth: of the Gaussian kernel [m]; radius: a turn counts as the shift that it gives at this
    distance [m].
    """

    def __init__(self, bandwidth: float, radius: float = 0.1) -> None:
        self.bandwidth, self.space = bandwidth, PoseSpace((0.0, 0.0, 0.0), radius)

    def __call__(
        self,
        particles: Particles,
        output: ParticleOutput,
        scene: Scene,
        method: Method,
        generator: Generator,
    ) -> Belief:
        """Return the belief."""
        mass = kernel_mass(
            output.pose.detach(), particles.log_weights.detach(), self.space, self.bandwidth
        )
        score, index = mass.max(1)
        return picked(particles, output, index, score)
