"""A last pass of importance sampling: particles that carry the posterior given the image once."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Generator, Tensor

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.filters.modes import find_pose_modes
from posefilter.filters.refine import scorer_of
from posefilter.filters.resample import effective_sample_size
from posefilter.geometry.pose_density import draw_poses, fit_density, log_density, widen
from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Encoding, Method
from posefilter.types import BeliefBatch

_HALVINGS = 30  # of the interval of a power


@dataclass(eq=False)
class ImportanceSampling:
    """Draw the particles anew from a density about the old ones, and weight them by the posterior.

    The filter's own weights come of a search that reads one image many times. Here the old
    particles only say where to look: q is their kernel density, widened. Particles are drawn from
    its kernels, and none from its background, which only bounds the weights of what lies far out.
    With T temperature, l the log-likelihood and a flat prior, new particles x ~ q have the weights

        w = exp(l(x) / T) / q(x)

    so that they carry the posterior exp(l / T), and the density that they were drawn from counts no
    more. A second round draws from the density of the first one's weighted particles (population
    Monte Carlo, Cappe et al. 2004). The estimate and its score are kept.

    Where the old particles lie beside a narrow mode, a few have nearly all of the weight, and the
    next density would be of these alone. Therefore weights that the next round draws by are
    tempered: taken to the power, 1 at most, that leaves an effective sample size of
    `min_effective` (nonlinear weights: Koblents and Miguez 2015). The last round's are as they are.

    Args:
        samples: Particles of a round.
        rounds: Number of rounds.
        widening: Factor of the first density's kernels.
        temperature: T; 1 takes the likelihood at its word, more makes the belief wider.
        sigma: Noise level of the likelihood [m].
        pixels: Image points that each particle is scored from, the same for all.
        min_effective: Least effective sample size of the weights that a round draws by, over the
            number of particles; 0 leaves them as they are.

    Raises:
        UserError: A number is out of range.
    """

    requires: ClassVar[Capabilities] = ("common_points", "pose_space", "score_poses")

    samples: int = 400
    rounds: int = 2
    widening: float = 2.0
    temperature: float = 1.0
    sigma: float = 0.004
    pixels: int = 256
    min_effective: float = 0.0

    def __post_init__(self) -> None:
        counts, widening, temperature = (self.samples, self.rounds), self.widening, self.temperature
        if min(counts) < 1 or not widening >= 1 or not temperature > 0:
            raise UserError(
                f"refine: importance sampling needs samples and rounds >= 1, widening >= 1 and "
                f"temperature > 0, got {self.samples}, {self.rounds}, {widening} and {temperature}"
            )
        if not (self.sigma > 0 and self.pixels >= 1 and 0 <= self.min_effective <= 1):
            raise UserError(
                "refine: importance sampling needs sigma > 0, pixels >= 1 and min_effective in "
                f"[0, 1], got {self.sigma}, {self.pixels} and {self.min_effective}"
            )

    @torch.no_grad()
    def __call__(
        self, belief: BeliefBatch, encoding: Encoding, method: Method, generator: Generator
    ) -> BeliefBatch:
        """Return the belief with new particles; without gradient."""
        poses, log_weights = belief.poses, belief.log_weights
        for number in range(self.rounds):
            widening = self.widening if number == 0 else 1.0
            if self.min_effective:
                log_weights = temper(log_weights, self.min_effective)
            poses, log_q = self.propose(poses, log_weights, method, widening, generator)
            score = scorer_of(method).score_poses(
                encoding, poses, self.sigma, generator, self.pixels
            )
            log_weights = (score.double() / self.temperature - log_q).log_softmax(1)
        return belief._replace(poses=poses, log_weights=log_weights.to(belief.log_weights))

    def propose(
        self,
        poses: Tensor,
        log_weights: Tensor,
        method: Method,
        widening: float,
        generator: Generator,
    ) -> tuple[Tensor, Tensor]:
        """Draw particles from the density of others.

        Args:
            poses: (B, N, 4, 4).
            log_weights: (B, N), normalized.
            method: Its space knows the object's center and size.
            widening: Factor of the kernels.
            generator: Source of randomness.

        Returns:
            Particles (B, samples, 4, 4), and their log density (B, samples), float64.
        """
        space = method.space
        assert isinstance(space, PoseSpace)  # of what `requires` says
        center = poses.new_tensor(space.center)
        drawn, log_q = [], []
        for particles, weights in zip(poses, log_weights, strict=True):
            # of a density's background alone the diameter counts: twice the radius will do
            diameter = 2 * space.radius
            member = find_pose_modes(particles, weights, space, diameter).member
            density = fit_density(particles, weights, center, space.radius, diameter, member=member)
            density = widen(density, widening)
            drawn.append(draw_poses(density, self.samples, generator))
            log_q.append(log_density(density, drawn[-1]))
        return torch.stack(drawn).to(poses), torch.stack(log_q)


def temper(log_weights: Tensor, least: float) -> Tensor:
    """Return the weights to the highest power, 1 at most, that keeps them even enough.

    Args:
        log_weights: (B, N), normalized.
        least: Effective sample size that they are to have at least, over N.

    Returns:
        (B, N), normalized.
    """
    # so that no weight to the power 0 is a number
    log_weights = log_weights.clamp_min(0.5 * torch.finfo(log_weights.dtype).min)
    low, high = torch.zeros_like(log_weights[:, :1]), torch.ones_like(log_weights[:, :1])
    power = high
    for _ in range(_HALVINGS):
        tempered = (power * log_weights).log_softmax(1)
        enough = effective_sample_size(tempered)[:, None] >= least * log_weights.shape[1]
        low, high = torch.where(enough, power, low), torch.where(enough, high, power)
        power = (low + high) / 2
    return (low * log_weights).log_softmax(1)
