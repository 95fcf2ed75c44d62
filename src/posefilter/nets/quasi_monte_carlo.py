"""Standard normal points of the plane that cover it more evenly than independent draws do."""

from functools import lru_cache

import torch
from torch import Generator, Tensor

# powers of the inverse of the root of x^3 = x + 1: the most even sequence of this kind in a plane
_STEP = (0.7548776662466927, 0.5698402909980532)
_EDGE = 1e-7  # of the unit square, that the quantile function is kept from


def draw_quasi_random(batch: int, count: int, generator: Generator, device: torch.device) -> Tensor:
    """Draw standard normal points: an additive sequence in the unit square, shifted at random.

    Every single point is standard normal, so that a mean over the points has the expectation that
    it has with independent ones (Cranley and Patterson 1976). Its variance is lower, since the
    points fill the plane without gaps and heaps.

    Args:
        batch: B sets of points, independent of each other.
        count: Points of a set, P.
        generator: Source of randomness.
        device: Where the points are to be.

    Returns:
        Points (B, 1, P, 2).

    References:
        Cranley, Patterson: Randomization of number theoretic methods for multiple integration. SIAM
            Journal on Numerical Analysis 13 (1976).
        Niederreiter: Random number generation and quasi-Monte Carlo methods. SIAM (1992).
    """
    shift = torch.rand(batch, 1, 1, 2, generator=generator, device=device, dtype=torch.float64)
    square = (_list_steps(count, device) + shift).frac()
    return torch.special.ndtri(square.clamp(_EDGE, 1 - _EDGE)).float()


@lru_cache(maxsize=32)
def _list_steps(count: int, device: torch.device) -> Tensor:
    """Return the sequence without its shift, (count, 2), made once: a GPU is waited for when it is
    sent numbers.
    """
    step = torch.tensor(_STEP, dtype=torch.float64, device=device)
    return torch.arange(count, device=device)[:, None] * step
