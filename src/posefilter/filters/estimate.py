"""Point estimates: one pose from the last weighted particles.

The belief always holds all particles with their weights.
"""

from typing import ClassVar

import torch
from torch import Generator, Tensor

from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Encoding, Method, Space
from posefilter.types import BeliefBatch, ParticleOutput, Particles


def select_particle(particles: Particles, output: ParticleOutput, scores: Tensor) -> BeliefBatch:
    """Return the belief of each image's particle of highest score.  scores (B, N)."""
    score, index = scores.max(1)
    rows = torch.arange(len(index), device=index.device)
    return BeliefBatch(output.pose, particles.log_weights, output.pose[rows, index], score)


class BestParticle:
    """Base of estimates that are one of the particles: the one that is rated highest.

    The score is its rating.
    """

    def __call__(
        self,
        particles: Particles,
        output: ParticleOutput,
        encoding: Encoding,
        method: Method,
        generator: Generator,
    ) -> BeliefBatch:
        """Return the belief."""
        return select_particle(particles, output, self.rate(particles, output, method))

    def rate(self, particles: Particles, output: ParticleOutput, method: Method) -> Tensor:
        """Return the particles' ratings, (B, N)."""
        raise NotImplementedError


class Argmax(BestParticle):
    """The pose of the particle of highest likelihood (the paper, section 5).

    The score is its log-likelihood.
    """

    score_is: ClassVar[str] = (
        "log-likelihood of the estimate, up to a constant of the image; no probability"
    )

    def rate(self, particles: Particles, output: ParticleOutput, method: Method) -> Tensor:
        """Return their log-likelihoods."""
        return output.log_likelihood


class Mean:
    """The weighted mean of the poses; the score is the weighted mean of the log-likelihoods.

    Poses are averaged about the object's center where the space knows it, else about the origin of
    the object's frame. Between two distant modes the mean is a pose of low probability: see
    DensestMode.
    """

    score_is: ClassVar[str] = (
        "weighted mean of the particles' log-likelihoods, up to a constant of the image; no "
        "probability"
    )

    def __call__(
        self,
        particles: Particles,
        output: ParticleOutput,
        encoding: Encoding,
        method: Method,
        generator: Generator,
    ) -> BeliefBatch:
        """Return the belief; differentiable in weights and poses."""
        space = method.space
        if not isinstance(space, PoseSpace):
            space = PoseSpace((0.0, 0.0, 0.0), 1.0)
        weights = particles.log_weights.exp()
        weighted = torch.where(weights > 0, weights * output.log_likelihood, 0.0)
        mean = space.mean(output.pose, weights)
        return BeliefBatch(output.pose, particles.log_weights, mean, weighted.sum(1))


def kernel_mass(
    state: Tensor, log_weights: Tensor, space: Space, bandwidth: float, chunk: int = 1 << 22
) -> Tensor:
    """Return the log of the kernel-weighted mass around each particle: a kernel density estimate.

    Args:
        state: (B, N, *S) particles.
        log_weights: (B, N), normalized.
        space: The space of the particles.
        bandwidth: Of the Gaussian kernel, in the space's unit ([m] or [px]).
        chunk: Distances held in memory at once.

    Returns:
        Log masses (B, N), at most 0.
    """
    rows = max(1, chunk // log_weights.numel())
    log_masses = []
    for block in state.split(rows, dim=1):
        distance = space.distance(block[:, :, None], state[:, None])
        log_kernel = -0.5 * (distance / bandwidth).square()
        log_masses.append((log_weights[:, None] + log_kernel).logsumexp(2))
    return torch.cat(log_masses, dim=1)


class DensestMode(BestParticle):
    """The pose of the particle of highest kernel density; the score is the log of its kernel mass.

    Particles of a space of poses are compared by the poses that they predict, since a method need
    not read all of a state.

    Args:
        bandwidth: Of the Gaussian kernel over the particles, in the space's unit ([m] or [px]).
    """

    score_is: ClassVar[str] = (
        "log of the weight of all particles, each by its kernel at the estimate: at most 0; no "
        "probability"
    )
    space: Space | None = None  # in which they are compared; None: the method's

    def __init__(self, bandwidth: float) -> None:
        self.bandwidth = bandwidth

    def rate(self, particles: Particles, output: ParticleOutput, method: Method) -> Tensor:
        """Return the logs of their kernel masses."""
        space = method.space if self.space is None else self.space
        where = (output.pose if isinstance(space, PoseSpace) else particles.state).detach()
        return kernel_mass(where, particles.log_weights.detach(), space, self.bandwidth)


class DensestPose(DensestMode):
    """The particle's pose of highest kernel density among poses, for particles of any space.

    Particles that are pixels can predict one pose from distant positions; this estimate compares
    the predicted poses, not the pixels. The score is the log of the kernel mass.

    Args:
        bandwidth: Of the Gaussian kernel [m].
        radius: Distance at which a rotation counts as the shift that it causes [m].
    """

    def __init__(self, bandwidth: float, radius: float = 0.1) -> None:
        super().__init__(bandwidth)
        self.space = PoseSpace((0.0, 0.0, 0.0), radius)
