"""Drawing children from a weighted cloud.

Each keeps the weighted mean: exactly or in expectation (tests/laws).
"""

import math

import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.protocols import Resample, Space
from posefilter.types import Particles, Resampled


def effective_size(log_weights: Tensor) -> Tensor:
    """Return the effective sample size 1 / sum w^2, from 1 (one particle has it all) to N (all
    alike).  (B, N) -> (B,).
    """
    return torch.exp(-torch.logsumexp(2 * log_weights, dim=1))


def draw(log_weights: Tensor, places: Tensor) -> Tensor:
    """Look up whose share of the weight each place falls into.

    (B, M) normalized, (B, N) in [0, 1) -> (B, N) int64.
    """
    sums = log_weights.detach().double().exp().cumsum(1)
    places = places.double() * sums[:, -1:]
    found = torch.searchsorted(sums, places.clamp_max(sums[:, -1:] * (1 - 1e-15)), right=True)
    return found.clamp_max(log_weights.shape[1] - 1)


class Fair:
    """Base of the classic schemes: a child's parent is drawn by weight, and all children start
    alike.

    Without gradient to the weights: which parent is drawn is a choice, not a function.
    """

    def __call__(
        self, particles: Particles, count: int, space: Space, generator: Generator
    ) -> Resampled:
        """Return children of equal weight."""
        places = self.places(
            len(particles.log_weights), count, generator, particles.log_weights.device
        )
        ancestors = draw(particles.log_weights, places)
        return Resampled(
            ancestors, particles.log_weights.new_full(ancestors.shape, -math.log(count))
        )

    def places(
        self, rows: int, particles: int, generator: Generator, device: torch.device
    ) -> Tensor:
        """Return where on the unit interval to look, (rows, particles)."""
        raise NotImplementedError


class Multinomial(Fair):
    """Independent draws: the textbook's bootstrap filter (Gordon et al. 1993), with the largest
    variance.
    """

    def places(
        self, rows: int, particles: int, generator: Generator, device: torch.device
    ) -> Tensor:
        """Return independent uniform places."""
        return torch.rand(rows, particles, generator=generator, device=device)


class Stratified(Fair):
    """One uniform draw in each N-th of the unit interval (Kitagawa 1996)."""

    def places(
        self, rows: int, particles: int, generator: Generator, device: torch.device
    ) -> Tensor:
        """Return one uniform place in each stratum."""
        u = torch.rand(rows, particles, generator=generator, device=device)
        return (torch.arange(particles, device=device) + u) / particles


class Systematic(Fair):
    """A comb with one random offset (Carpenter et al. 1999): a particle of weight w has floor(N w)
    or ceil(N w) children.
    """

    def places(
        self, rows: int, particles: int, generator: Generator, device: torch.device
    ) -> Tensor:
        """Return a comb with an offset an image."""
        u = torch.rand(rows, 1, generator=generator, device=device)
        return (torch.arange(particles, device=device) + u) / particles


class Soft:
    """Draw from a mixture of the weights (share alpha) and the uniform, and weigh the children by
    what that distorts.

    Their weights w / q carry the gradient back to the parents' (Karkus et al. 2018). Here q is held
    fixed in it: then the gradient of a weighted mean is right in expectation, even at alpha = 1
    (Scibior and Wood 2021); else it is not. alpha: 1 is fair, 0 ignores weights.
    """

    def __init__(self, alpha: float = 0.5) -> None:
        if not 0 <= alpha <= 1:
            raise UserError(f"resample.alpha={alpha} must lie between 0 and 1")
        self.alpha = alpha
        self.scheme = Systematic()

    def __call__(
        self, particles: Particles, count: int, space: Space, generator: Generator
    ) -> Resampled:
        """Return children whose weights are normalized."""
        log_w = particles.log_weights
        mixed = self.alpha * log_w.detach().exp() + (1 - self.alpha) / log_w.shape[1]
        log_q = mixed.clamp_min(torch.finfo(mixed.dtype).tiny).log()
        ancestors = self.scheme(
            particles._replace(log_weights=log_q), count, space, generator
        ).ancestors
        return Resampled(ancestors, torch.log_softmax((log_w - log_q).gather(1, ancestors), dim=1))


class NoResampling:
    """Keep every particle and its weight."""

    def __call__(
        self, particles: Particles, count: int, space: Space, generator: Generator
    ) -> Resampled:
        """Return each particle as its own child."""
        B, M = particles.log_weights.shape
        if count != M:
            raise UserError(
                f"resample=none cannot turn {M} particles into {count}: leave "
                f"filter.first_particles out"
            )
        return Resampled(
            torch.arange(M, device=particles.state.device).expand(B, M), particles.log_weights
        )


class BelowESS:
    """Resample an image's cloud only where its effective sample size is below a share of its
    particles; else keep it.

    Each image of a batch decides for itself. A cloud whose size must change is always resampled.
    """

    def __init__(self, resampler: Resample, threshold: float = 0.5) -> None:
        self.resampler, self.threshold = resampler, threshold

    def __call__(
        self, particles: Particles, count: int, space: Space, generator: Generator
    ) -> Resampled:
        """Return children, of which those of rich clouds are their parents with their weights."""
        drawn = self.resampler(particles, count, space, generator)
        M = particles.log_weights.shape[1]
        if count != M:
            return drawn
        poor = (effective_size(particles.log_weights) < self.threshold * M)[:, None]
        kept = NoResampling()(particles, count, space, generator)
        shares = drawn.shares
        if shares is not None:
            shares = torch.where(
                poor[..., None], shares, torch.eye(M, dtype=shares.dtype, device=shares.device)
            )
        ancestors = torch.where(poor, drawn.ancestors, kept.ancestors)
        return Resampled(ancestors, torch.where(poor, drawn.log_weights, kept.log_weights), shares)
