"""Resampling schemes: drawing ancestors from weighted particles.

Each scheme keeps weighted means, exactly or in expectation (tests/laws), but for `Soft` and
`AuxiliaryResampling`: these divide the children's weights by their sum, which is a bias of the
order of 1 / N. For a comparison see Douc, Cappe and Moulines (2005), and Chopin and
Papaspiliopoulos (2020, chapter 9).
"""

import math
from typing import ClassVar

import torch
from torch import Generator, Tensor

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.protocols import Resample, Space
from posefilter.types import Particles, Resampled


def effective_sample_size(log_weights: Tensor) -> Tensor:
    """Return the effective sample size 1 / sum w^2 (Kong, Liu and Wong 1994).

    It is 1 where one particle has all the weight, N where weights are equal.  (B, N) -> (B,).
    """
    return torch.exp(-torch.logsumexp(2 * log_weights, dim=1))


def inverse_cdf(log_weights: Tensor, uniforms: Tensor) -> Tensor:
    """Return the ancestors at given values of the weights' cumulative distribution.

    (B, M) normalized log weights, (B, N) in [0, 1) -> (B, N) int64.
    """
    sums = log_weights.detach().double().exp().cumsum(1)
    uniforms = uniforms.double() * sums[:, -1:]
    ancestors = torch.searchsorted(sums, uniforms.clamp_max(sums[:, -1:] * (1 - 1e-15)), right=True)
    return ancestors.clamp_max(log_weights.shape[1] - 1)


class InverseCDF:
    """Base of unbiased schemes: ancestors are the inverse CDF at N points of the unit interval.

    Children have equal weights. There is no gradient in the weights, since the choice of an
    ancestor is discrete.
    """

    provides: ClassVar[Capabilities] = ("recordable",)

    def __call__(
        self, particles: Particles, count: int, space: Space, generator: Generator
    ) -> Resampled:
        """Return children of equal weight."""
        log_w = particles.log_weights
        uniforms = self.uniforms(len(log_w), count, generator, log_w.device)
        ancestors = inverse_cdf(log_w, uniforms)
        return Resampled(ancestors, log_w.new_full(ancestors.shape, -math.log(count)))

    def uniforms(self, rows: int, count: int, generator: Generator, device: torch.device) -> Tensor:
        """Return points of the unit interval, (rows, count)."""
        raise NotImplementedError


class Multinomial(InverseCDF):
    """Independent draws, as in the bootstrap filter (Gordon et al. 1993); the largest variance."""

    def uniforms(self, rows: int, count: int, generator: Generator, device: torch.device) -> Tensor:
        """Return independent uniforms."""
        return torch.rand(rows, count, generator=generator, device=device)


class Stratified(InverseCDF):
    """One uniform in each of N equal strata (Kitagawa 1996)."""

    def uniforms(self, rows: int, count: int, generator: Generator, device: torch.device) -> Tensor:
        """Return one uniform of each stratum."""
        u = torch.rand(rows, count, generator=generator, device=device)
        return (torch.arange(count, device=device) + u) / count


class Systematic(InverseCDF):
    """One uniform offset for all strata (Carpenter, Clifford and Fearnhead 1999).

    A particle of weight w has floor(N w) or ceil(N w) children.
    """

    def uniforms(self, rows: int, count: int, generator: Generator, device: torch.device) -> Tensor:
        """Return evenly spaced points with one random offset for each image."""
        u = torch.rand(rows, 1, generator=generator, device=device)
        return (torch.arange(count, device=device) + u) / count


class Soft:
    """Soft resampling: draw from a mixture of the weights and the uniform (Karkus et al. 2018).

    With proposal q = alpha w + (1 - alpha) / M, children have the importance weights w / q, which
    carry gradients to their ancestors' weights. Here q is detached. At alpha = 1 the gradient of a
    weighted mean is then unbiased (Scibior and Wood 2021) but for the normalization of the weights,
    whose bias falls as 1 / M; otherwise it need not be.

    Args:
        alpha: Share of the weights in the mixture; 1 is unbiased resampling, 0 ignores the weights.

    Raises:
        UserError: `alpha` is out of [0, 1].
    """

    def __init__(self, alpha: float = 0.5) -> None:
        if not 0 <= alpha <= 1:
            raise UserError(f"filter.resample.alpha={alpha} must lie between 0 and 1")
        self.alpha = alpha
        self.scheme = Systematic()

    def __call__(
        self, particles: Particles, count: int, space: Space, generator: Generator
    ) -> Resampled:
        """Return children with normalized importance weights."""
        log_w = particles.log_weights
        mixed = self.alpha * log_w.detach().exp() + (1 - self.alpha) / log_w.shape[1]
        log_q = mixed.clamp_min(torch.finfo(mixed.dtype).tiny).log()
        drawn = self.scheme(particles._replace(log_weights=log_q), count, space, generator)
        ancestors = drawn.ancestors
        ratio = (log_w - log_q).gather(1, ancestors)
        # where the weights of all that were drawn are 0, they are equal
        ratio = ratio.clamp_min(0.5 * torch.finfo(ratio.dtype).min)
        return Resampled(ancestors, torch.log_softmax(ratio, dim=1))


class NoResampling:
    """Keep every particle and its weight: sequential importance sampling."""

    def __call__(
        self, particles: Particles, count: int, space: Space, generator: Generator
    ) -> Resampled:
        """Return each particle as its own child.

        Raises:
            UserError: `count` differs from the number of particles.
        """
        B, M = particles.log_weights.shape
        if count != M:
            raise UserError(
                f"filter/resample=none cannot turn {M} particles into {count}: leave "
                f"filter.initial_particles out"
            )
        ancestors = torch.arange(M, device=particles.state.device).expand(B, M)
        return Resampled(ancestors, particles.log_weights)


class AdaptiveResampling:
    """Adaptive resampling: only where the effective sample size is low (Liu and Chen 1995).

    Each image of a batch is treated independently. If the number of particles changes, all images
    are new.

    Args:
        resampler: The scheme that draws the ancestors.
        threshold: Effective sample size below which to resample, over the number of particles.
    """

    def __init__(self, resampler: Resample, threshold: float = 0.5) -> None:
        self.resampler, self.threshold = resampler, threshold

    def __call__(
        self, particles: Particles, count: int, space: Space, generator: Generator
    ) -> Resampled:
        """Return children; in images above the threshold they are the particles themselves."""
        new = self.resampler(particles, count, space, generator)
        M = particles.log_weights.shape[1]
        if count != M:
            return new
        low = (effective_sample_size(particles.log_weights) < self.threshold * M)[:, None]
        unchanged = NoResampling()(particles, count, space, generator)
        mixture_weights = new.mixture_weights
        if mixture_weights is not None:
            itself = torch.eye(M).to(mixture_weights)
            mixture_weights = torch.where(low[..., None], mixture_weights, itself)
        ancestors = torch.where(low, new.ancestors, unchanged.ancestors)
        log_weights = torch.where(low, new.log_weights, unchanged.log_weights)
        return Resampled(ancestors, log_weights, mixture_weights)


def normalize_log_weights(particles: Particles) -> tuple[Particles, Tensor]:
    """Return particles with normalized weights, and the logs of the sums before, (B, 1)."""
    log_sum = particles.log_weights.logsumexp(1, keepdim=True)
    # of particles without weight any will do
    log_w = (particles.log_weights - log_sum).nan_to_num(0.0).log_softmax(1)
    return particles._replace(log_weights=log_w), log_sum


class Islands:
    """Resample within groups of particles that never mix (Verge et al. 2015).

    Between equal modes, resampling is a random walk of their masses that ends with one of them
    (genetic drift).  Islands drift independently, so that what one loses another may keep.  A child
    has its island's weight over the number of the island's children, which keeps weighted means in
    expectation.

    Verge, Dubarry, Del Moral, Moulines: On parallel implementation of sequential Monte Carlo
    methods: the island particle model. Statistics and Computing 25 (2015).

    Args:
        resampler: The scheme that draws the ancestors in each island.
        size: Particles of an island, at least: the islands' number divides those of the particles
            before and after.

    Raises:
        UserError: The size is below 1.
    """

    def __init__(self, resampler: Resample, size: int = 50) -> None:
        if size < 1:
            raise UserError(f"filter.resample.size={size} must be 1 or more")
        self.resampler, self.size = resampler, size

    def __call__(
        self, particles: Particles, count: int, space: Space, generator: Generator
    ) -> Resampled:
        """Return children; those of an island follow one another."""
        B, M = particles.log_weights.shape
        most = max(1, min(M, count) // self.size)
        islands = max(n for n in range(1, most + 1) if not (M % n or count % n))
        shape = B * islands, M // islands
        by_island = Particles(*(x.reshape(*shape, *x.shape[2:]) for x in particles))
        by_island, log_island = normalize_log_weights(by_island)
        resampled = self.resampler(by_island, count // islands, space, generator)
        if resampled.mixture_weights is not None:
            raise UserError("filter/resample=islands needs a scheme that draws ancestors")
        first = torch.arange(islands, device=log_island.device)[:, None] * (M // islands)
        ancestors = resampled.ancestors.view(B, islands, -1) + first
        log_weights = (resampled.log_weights + log_island).view(B, count)
        return Resampled(ancestors.flatten(1), log_weights)
