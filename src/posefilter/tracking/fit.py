"""The maximum of a likelihood near an estimate, by a quadratic through many noisy scores.

A tracked pose is near the maximum, and only a few poses can be scored in a frame. A mean weighted
by the likelihood rests on the few of them that score highest; a regression uses all alike.
"""

from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from posefilter.filters.refine import scorer_of
from posefilter.protocols import Encoding, Method
from posefilter.types import BeliefBatch

_LONGEST = 1.5  # standard deviations of the perturbations, by which an iteration moves at most


@dataclass(eq=False)
class QuadraticFit:
    """Move the estimate to the maximum of a quadratic fitted to the scores about it: a `Refine`.

    The response-surface method of Box and Wilson (1951). Perturbations come in antithetic pairs:
    half the difference of a pair's scores is linear in the perturbation, and gives the slope; half
    their sum is even in it, and gives the curvature along each axis. Slope and curvature are
    regressions over all pairs. A normal prior of `prior_std` standard deviations of the
    perturbations holds what the likelihood leaves open: a constant likelihood leaves the estimate
    in place.

    Args:
        iterations: Number of fits, each about the estimate of the one before.
        pairs: Antithetic pairs of a fit, at least 8.
        spread: Standard deviation of the perturbations [m on the object's surface].
        sigma: Noise level of the likelihood [m].
        pixels: Image points for each score, the same for all poses of a fit.
        prior_std: Standard deviation of the prior, over that of the perturbations.

    References:
        Box, Wilson: On the experimental attainment of optimum conditions. Journal of the Royal
            Statistical Society B 13 (1951).
    """

    iterations: int = 1
    pairs: int = 16
    spread: float = 0.006
    sigma: float = 0.004
    pixels: int = 256
    prior_std: float = 2.0

    @torch.no_grad()
    def __call__(
        self, belief: BeliefBatch, encoding: Encoding, method: Method, generator: Generator
    ) -> BeliefBatch:
        """Return the belief with the estimate moved."""
        scorer, best, space = scorer_of(method), belief.best, method.space
        for _ in range(self.iterations):
            scale = space.noise_scale(best.new_tensor(self.spread))
            noise = draw_orthogonal(best, self.pairs, space.dimensions, generator)
            moves = torch.cat([noise, -noise], dim=1) * scale
            poses = space.move(best[:, None].expand(-1, 2 * self.pairs, -1, -1), moves)
            scores = scorer.score_poses(encoding, poses, self.sigma, generator, self.pixels)
            up, down = scores.chunk(2, dim=1)
            best = space.move(best, find_maximum(noise, up, down, self.prior_std) * scale)
        score = scorer.score_poses(encoding, best[:, None], self.sigma, generator, self.pixels)
        return belief._replace(best=best, score=score[:, 0])


def draw_orthogonal(like: Tensor, pairs: int, dimensions: int, generator: Generator) -> Tensor:
    """Draw perturbations that are at right angles to each other, in groups of as many as there are
    dimensions.

    Each is distributed as a standard normal vector. In a group the error of one axis' slope does
    not enter another's, so that fewer pairs are needed than of independent vectors.

    Args:
        like: (B, ...) gives number of images, type and device.
        pairs: Number of perturbations, P.
        dimensions: Of a perturbation, D.
        generator: Source of randomness.

    Returns:
        Perturbations (B, P, D).

    References:
        Mezzadri: How to generate random matrices from the classical compact groups. Notices of the
            AMS 54 (2007).
    """
    groups = -(-pairs // dimensions)
    shape = (len(like), groups, dimensions, dimensions)
    draw = torch.randn(shape, generator=generator, device=like.device, dtype=like.dtype)
    turn, triangle = torch.linalg.qr(draw)
    # with these signs it is uniform over all turns
    turn = turn * triangle.diagonal(dim1=-2, dim2=-1).sign()[..., None, :]
    length = draw.norm(dim=-2, keepdim=True)  # of columns, independent of where they point
    return (turn * length).mT.flatten(1, 2)[:, :pairs]


def find_maximum(noise: Tensor, up: Tensor, down: Tensor, prior_std: float) -> Tensor:
    """Return where a quadratic with axes along the coordinates, fitted to scores, is highest.

    Args:
        noise: (B, P, D) perturbations, of unit scale.
        up: (B, P) scores at the perturbations.
        down: (B, P) scores at their opposites.
        prior_std: Standard deviation of the prior about 0.

    Returns:
        The maximum (B, D) of fit and prior, within `_LONGEST` along each axis.
    """
    slope = regress(noise, (up - down) / 2)
    ones = torch.ones_like(noise[..., :1])
    curvature = regress(torch.cat([ones, noise.square() / 2], dim=-1), (up + down) / 2)[:, 1:]
    step = slope / ((-curvature).clamp_min(0) + 1 / prior_std**2)
    return step.clamp(-_LONGEST, _LONGEST)


def regress(x: Tensor, y: Tensor) -> Tensor:
    """Return the coefficients of least squares, a little damped.  (B, P, F), (B, P) -> (B, F)."""
    damping = 1e-4 * torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
    found: Tensor = torch.linalg.solve(x.mT @ x + damping, x.mT @ y[..., None])
    return found[..., 0]
