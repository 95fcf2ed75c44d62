"""A last pass of importance sampling: particles that carry the posterior given the image once."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Generator, Tensor

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.filters.modes import find_pose_modes
from posefilter.filters.refine import scorer_of
from posefilter.geometry.pose_density import draw_poses, fit_density, log_density, widen
from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Encoding, Method
from posefilter.types import BeliefBatch


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

    The masses of the search's modes are no guide: with `equal_modes` the first round draws as often
    from each, so that one of little mass, or of much that the search missed, is weighed as well.

    Args:
        samples: Particles of a round.
        rounds: Number of rounds.
        widening: Factor of the first density's kernels.
        temperature: T; 1 takes the likelihood at its word, more makes the belief wider.
        sigma: Noise level of the likelihood [m].
        pixels: Image points that each particle is scored from, the same for all.
        equal_modes: Whether the first density gives each mode the same mass.

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
    equal_modes: bool = False

    def __post_init__(self) -> None:
        counts, widening, temperature = (self.samples, self.rounds), self.widening, self.temperature
        if min(counts) < 1 or not widening >= 1 or not temperature > 0:
            raise UserError(
                f"refine: importance sampling needs samples and rounds >= 1, widening >= 1 and "
                f"temperature > 0, got {self.samples}, {self.rounds}, {widening} and {temperature}"
            )

    @torch.no_grad()
    def __call__(
        self, belief: BeliefBatch, encoding: Encoding, method: Method, generator: Generator
    ) -> BeliefBatch:
        """Return the belief with new particles; without gradient."""
        poses, log_weights = belief.poses, belief.log_weights
        for number in range(self.rounds):
            widening, equal = (self.widening, self.equal_modes) if number == 0 else (1.0, False)
            poses, log_q = self.propose(poses, log_weights, method, widening, generator, equal)
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
        equal_modes: bool,
    ) -> tuple[Tensor, Tensor]:
        """Draw particles from the density of others.

        Args:
            poses: (B, N, 4, 4).
            log_weights: (B, N), normalized.
            method: Its space knows the object's center and size.
            widening: Factor of the kernels.
            generator: Source of randomness.
            equal_modes: Whether each mode of the density has the same mass.

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
            modes = find_pose_modes(particles, weights, space, diameter)
            member = modes.member
            if equal_modes:
                mass = modes.weights.to(weights)[member]
                weights = (weights - mass.log()).log_softmax(0)
            density = fit_density(particles, weights, center, space.radius, diameter, member=member)
            density = widen(density, widening)
            drawn.append(draw_poses(density, self.samples, generator))
            log_q.append(log_density(density, drawn[-1]))
        return torch.stack(drawn).to(poses), torch.stack(log_q)
