"""Resampling within niches: every peak of the weights keeps particles, however little its mass.

Where a likelihood is annealed, a narrow mode has few particles while the likelihood is still flat,
and ordinary resampling loses it for good (Woodard, Schmidler and Huber 2009). Niches, which
evolutionary search uses to keep several optima (Mahfoud 1995), reserve a share of the particles for
each of them.

References:
    Mahfoud: Niching methods for genetic algorithms. PhD thesis, University of Illinois (1995).
    Rodriguez, Laio: Clustering by fast search and find of density peaks. Science 344 (2014).
    Woodard, Schmidler, Huber: Sufficient conditions for torpid mixing of parallel and simulated
        tempering. Electronic Journal of Probability 14 (2009).
"""

import math

import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.filters.resample import inverse_cdf
from posefilter.protocols import Space
from posefilter.types import Particles, Resampled

_LIGHTEST = 1e-4  # of the largest weight: a lighter particle is no peak
_PAIRS = 1 << 20  # distances that are held at once


class Niches:
    """Resample within niches, which have equally many children, up to one.

    A particle is the farther from all heavier ones, the more it is a peak of its own: the particles
    of which this distance is largest are the peaks (Rodriguez and Laio 2014), and a niche is all
    that is nearer to its peak than to others. Within a niche children are drawn systematically. A
    child has its niche's weight over the number of the niche's children, which keeps weighted means
    in expectation. With fewer modes than niches a mode has several.

    Args:
        niches: Their number at most.

    Raises:
        UserError: The number is below 1.
    """

    def __init__(self, niches: int = 20) -> None:
        if niches < 1:
            raise UserError(f"filter.resample.niches={niches} must be 1 or more")
        self.niches = niches

    def __call__(
        self, particles: Particles, count: int, space: Space, generator: Generator
    ) -> Resampled:
        """Return children; those of a niche follow one another."""
        log_w, children = particles.log_weights, []
        for state, own in zip(particles.state, log_w.detach(), strict=True):
            peaks = find_peaks(state, own, space, min(self.niches, count))
            niche = space.distance(state[:, None], state[peaks]).argmin(1)
            niche[peaks] = torch.arange(len(peaks), device=niche.device)  # equal ones apart
            children.append(draw_within(own, niche, len(peaks), count, generator))
        ancestors, log_weights = (torch.stack(parts) for parts in zip(*children, strict=True))
        return Resampled(ancestors, log_weights.to(log_w))


def find_peaks(state: Tensor, log_weights: Tensor, space: Space, most: int) -> Tensor:
    """Return the particles that are farthest from all heavier ones.

    Args:
        state: (N, *S).
        log_weights: (N,).
        space: Of the particles.
        most: Number of peaks, at most.

    Returns:
        (K,) int64, the heaviest particle among them.
    """
    order = log_weights.argsort(descending=True, stable=True)
    lightest = log_weights[order[0]] + math.log(_LIGHTEST)
    order = order[~(log_weights[order] < lightest)]  # what is no number fails after the last step
    sorted_state = state[order]
    index = torch.arange(len(order), device=order.device)
    apart = []
    for block in index.split(max(1, _PAIRS // len(order))):
        heavier = index[: int(block[-1]) + 1]
        distance = space.distance(sorted_state[block][:, None], sorted_state[heavier])
        apart.append(distance.masked_fill(heavier >= block[:, None], torch.inf).amin(1))
    farthest = torch.cat(apart)
    return order[farthest.argsort(descending=True, stable=True)[:most]]


def draw_within(
    log_weights: Tensor, niche: Tensor, niches: int, count: int, generator: Generator
) -> tuple[Tensor, Tensor]:
    """Draw ancestors in each niche, systematically; the first niches have one child more where the
    niches' number is no divisor of `count`.

    (M,) normalized, (M,) int64 the niche of each particle -> (count,) int64, (count,) log weights.
    """
    each = torch.arange(niches, device=niche.device)[:, None]
    own = log_weights.double().masked_fill(niche != each, -torch.inf)
    mass = own.logsumexp(1, keepdim=True)
    children = count // niches + (each < count % niches)
    rank = torch.arange(int(children[0]), device=niche.device)
    offset = torch.rand(niches, 1, generator=generator, device=niche.device)
    ancestors = inverse_cdf(own - mass, (rank + offset) / children)
    weights = (mass - children.log()).expand_as(ancestors)
    is_child = rank < children
    return ancestors[is_child], weights[is_child]
