"""Resampling by optimal transport, which moves particles as little as it can (Reich 2013)."""

import math

import torch
from torch import Generator, Tensor

from posefilter.filters.resample import inverse_cdf
from posefilter.protocols import Space
from posefilter.types import Particles, Resampled


def sinkhorn(cost: Tensor, log_a: Tensor, log_b: Tensor, epsilon: float, iterations: int) -> Tensor:
    """Return the log of the entropy-regularized transport plan (Cuturi 2013), in the log domain.

    The last update is that of the columns: their sums are exact, those of the rows approximate.

    Args:
        cost: (B, N, M) >= 0.
        log_a: (B, N) normalized log weights of the rows.
        log_b: (B, M) normalized log weights of the columns.
        epsilon: Regularization, in the unit of the cost.
        iterations: Number of updates of rows and columns.

    Returns:
        Log plan (B, N, M).
    """
    kernel = -cost / epsilon
    g = torch.zeros_like(log_b)
    f = torch.zeros_like(log_a)
    for _ in range(iterations):
        f = log_a - torch.logsumexp(kernel + g[:, None], dim=2)
        g = log_b - torch.logsumexp(kernel + f[..., None], dim=1)
    return kernel + f[..., None] + g[:, None]


class SampledTransport:
    """Draw each child's ancestor from its row of the plan that carries the weights to equal ones.

    The choice `filter/resample=optimal_transport_sampled`. It copies particles, where the ensemble
    transform mixes them. Children's targets are an even selection of the particles, so an ancestor
    is mostly the particle itself or a neighbor. The plan is the coupling of Reich (2013),
    regularized by its entropy (Cuturi 2013).

    Args:
        epsilon: Regularization, over the mean squared distance.
        iterations: Iterations of Sinkhorn's algorithm.
    """

    def __init__(self, epsilon: float = 0.05, iterations: int = 50) -> None:
        self.epsilon, self.iterations = epsilon, iterations

    def __call__(
        self, particles: Particles, count: int, space: Space, generator: Generator
    ) -> Resampled:
        """Return children of (nearly) equal weight."""
        log_plan = self.plan(particles, count, space)
        log_weights = torch.logsumexp(log_plan, dim=2)
        u = torch.rand(log_weights.shape, generator=generator, device=log_plan.device)
        rows = (log_plan - log_weights[..., None]).flatten(0, 1)
        return Resampled(inverse_cdf(rows, u.flatten()[:, None]).view_as(u), log_weights)

    def plan(self, particles: Particles, count: int, space: Space) -> Tensor:
        """Return the log plan (B, N, M), differentiable in the weights and in the states.

        Its columns sum to the weights, its rows nearly to 1 / N. The rows' error remains in the
        children's weights, so means are kept.
        """
        M = particles.state.shape[1]
        every = torch.linspace(0, M - 1, count, device=particles.state.device).round().long()
        targets = particles.state[:, every]
        cost = space.distance(targets[:, :, None], particles.state[:, None]).square()
        cost = cost / cost.mean((1, 2), keepdim=True).clamp_min(1e-12)
        # the potential of a particle without weight would be infinite
        log_b = torch.log_softmax(particles.log_weights.clamp_min(-80.0), dim=1)
        log_a = torch.full_like(cost[..., 0], -math.log(count))
        return sinkhorn(cost, log_a, log_b, self.epsilon, self.iterations)


class EnsembleTransform(SampledTransport):
    """The ensemble transform: each child is the mean of its row of the plan (Reich 2013).

    With the entropic plan it is differentiable: the optimal-transport resampling of Corenflos et
    al. (2021), the choice `filter/resample=optimal_transport`. The weighted mean of pixels and of
    positions is exact, and that of rotations nearly so, since a chordal mean of chordal means is
    not that of all. The covariance shrinks with epsilon, so the filter lags behind a moving target.
    """

    def __call__(
        self, particles: Particles, count: int, space: Space, generator: Generator
    ) -> Resampled:
        """Return mixtures of (nearly) equal weight; `ancestors` are their largest components."""
        log_plan = self.plan(particles, count, space)
        return Resampled(
            log_plan.argmax(2), torch.logsumexp(log_plan, dim=2), torch.softmax(log_plan, dim=2)
        )
