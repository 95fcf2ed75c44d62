"""Resampling by optimal transport: children stay as near as they can to where particles were."""

import math

import torch
from torch import Generator, Tensor

from posefilter.filters.resample import draw
from posefilter.protocols import Space
from posefilter.types import Particles, Resampled


def sinkhorn(cost: Tensor, log_a: Tensor, log_b: Tensor, epsilon: float, iterations: int) -> Tensor:
    """Return the log of the entropy-regularized transport plan between two weightings (Cuturi
    2013), in the log domain.

    cost (B, N, M) >= 0, log_a (B, N), log_b (B, M), each normalized -> (B, N, M). Ends on the
    columns' update, so that they sum to b exactly; the rows sum to a as far as the iterations came.
    """
    kernel = -cost / epsilon
    g = torch.zeros_like(log_b)
    f = torch.zeros_like(log_a)
    for _ in range(iterations):
        f = log_a - torch.logsumexp(kernel + g[:, None], dim=2)
        g = log_b - torch.logsumexp(kernel + f[..., None], dim=1)
    return kernel + f[..., None] + g[:, None]


class OptimalTransport:
    """Draw each child's parent from its row of the entropy-regularized plan that carries the
    weights to equal ones.

    Children's places are an even selection of the particles, so a parent is mostly itself or a
    neighbor: this coupling keeps the randomness small, where multinomial draws shuffle. epsilon:
    regularization, over the mean squared distance.
    """

    def __init__(self, epsilon: float = 0.05, iterations: int = 50) -> None:
        self.epsilon, self.iterations = epsilon, iterations

    def __call__(
        self, particles: Particles, count: int, space: Space, generator: Generator
    ) -> Resampled:
        """Return children of (nearly) equal weight."""
        log_plan = self.plan(particles, count, space)
        log_weights = torch.logsumexp(log_plan, dim=2)
        places = torch.rand(log_weights.shape, generator=generator, device=log_plan.device)
        rows = (log_plan - log_weights[..., None]).flatten(0, 1)
        return Resampled(draw(rows, places.flatten()[:, None]).view_as(places), log_weights)

    def plan(self, particles: Particles, count: int, space: Space) -> Tensor:
        """Return the log plan (B, N, M), differentiable in the weights; its columns sum to them,
        its rows nearly to 1 / N.

        What the rows are off after the last iteration goes into the children's weights, so the mean
        is kept all the same.
        """
        # the distances are held fixed: they have no slope where a child is its own parent
        with torch.no_grad():
            M = particles.state.shape[1]
            chosen = particles.state[
                :, torch.linspace(0, M - 1, count, device=particles.state.device).round().long()
            ]
            cost = space.distance(chosen[:, :, None], particles.state[:, None]).square()
            cost = cost / cost.mean((1, 2), keepdim=True).clamp_min(1e-12)
        # of no weight at all no potential is finite
        log_b = torch.log_softmax(particles.log_weights.clamp_min(-80.0), dim=1)
        log_a = torch.full_like(cost[..., 0], -math.log(count))
        return sinkhorn(cost, log_a, log_b, self.epsilon, self.iterations)


class Ensemble(OptimalTransport):
    """Make each child the mean of its row of the plan: no draw at all, so gradients flow (Corenflos
    et al. 2021).

    The weighted mean is kept exactly (on poses, that of the space); the spread shrinks, with
    epsilon and since light particles in the tails are merged, so the filter lags a little behind
    what it follows.
    """

    def __call__(
        self, particles: Particles, count: int, space: Space, generator: Generator
    ) -> Resampled:
        """Return children of (nearly) equal weight, as mixes; `parents` are their main ones."""
        log_plan = self.plan(particles, count, space)
        return Resampled(
            log_plan.argmax(2), torch.logsumexp(log_plan, dim=2), torch.softmax(log_plan, dim=2)
        )
