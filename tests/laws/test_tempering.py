"""One image's evidence counts once under LikelihoodRatio, at every level under the others: measured
on a Gaussian score.
"""

import math

import pytest
import torch
from torch import Generator, Tensor

from posefilter.filters.estimate import Argmax
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.propagate import Gaussian
from posefilter.filters.refine import NoRefine
from posefilter.filters.resample import AdaptiveResampling, Systematic
from posefilter.filters.reweight import CurrentLikelihood, LikelihoodRatio, SequentialBayes
from posefilter.filters.schedule import Constant, Geometric
from posefilter.geometry.spaces import PixelSpace
from posefilter.protocols import Reweight
from posefilter.types import ParticleOutput, Particles, Step, Trace

PLACE, WIDTH, PRIOR, STEPS, FACTOR = 1.5, 0.5, 2.0, 8, 0.3
RUNS = 32


class Bump:
    """A method whose score at noise level sigma is that of a Gaussian of width sqrt(WIDTH^2 +
    sigma^2).
    """

    space = PixelSpace()
    latent_width = 0

    def encode(self, batch: None) -> None:
        return None

    def measure(
        self, encoding: None, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        var = WIDTH**2 + float(step.sigma) ** 2
        score = -0.5 * (particles.state - PLACE).square().sum(-1) / var
        return ParticleOutput(
            score,
            torch.zeros_like(particles.state),
            torch.eye(4).expand(*score.shape, 4, 4),
            particles.latent,
        )


def start(
    batch: None, encoding: None, method: Bump, particles: int, generator: Generator
) -> Tensor:
    return PRIOR * torch.randn(RUNS, particles, 2, generator=generator)


def run(reweight: Reweight, schedule: Constant | Geometric) -> Trace:
    pieces = (
        start,
        schedule,
        reweight,
        AdaptiveResampling(Systematic(), 0.7),
        Gaussian(FACTOR),
        Argmax(),
        NoRefine(),
    )
    return ParticleFilter(2000, STEPS, *pieces)(None, Bump(), Generator().manual_seed(0))


def moments(particles: Particles) -> tuple[float, float]:
    weights = particles.log_weights.exp()[..., None]
    mean = (weights * particles.state).sum(1, keepdim=True)
    return float(mean.mean()), float(
        (weights * (particles.state - mean).square()).sum(1).mean().sqrt()
    )


@pytest.mark.parametrize(
    "schedule", [Constant(0.2), Geometric(2.0, 0.05)], ids=["constant", "falling"]
)
def test_tempered_weights_target_the_last_level_alone(schedule: Constant | Geometric) -> None:
    levels = schedule(STEPS)
    # as diffused by the moves
    prior = PRIOR**2 + sum((FACTOR * sigma) ** 2 for sigma in levels[1:])
    seen = WIDTH**2 + levels[-1] ** 2
    spread = math.sqrt(prior * seen / (prior + seen))
    mean = PLACE * prior / (prior + seen)
    trace = run(LikelihoodRatio(), schedule)
    found_mean, found_spread = moments(trace.particles[-1])
    assert found_mean == pytest.approx(mean, abs=0.04 * spread)
    assert found_spread == pytest.approx(spread, rel=0.03)
    exact = (
        math.log(2 * math.pi * seen)
        - math.log(2 * math.pi * (prior + seen))
        - PLACE**2 / (prior + seen)
    )
    assert float(trace.log_evidence.sum(1).exp().mean().log()) == pytest.approx(exact, abs=0.04)


@pytest.mark.parametrize(
    "reweight", [CurrentLikelihood(), SequentialBayes()], ids=lambda x: type(x).__name__
)
def test_the_others_are_too_sure_of_one_image(reweight: Reweight) -> None:
    schedule = Constant(0.2)
    assert (
        moments(run(reweight, schedule).particles[-1])[1]
        < 0.85 * moments(run(LikelihoodRatio(), schedule).particles[-1])[1]
    )


def test_measuring_one_image_t_times_narrows_it_by_the_root_of_t() -> None:
    output = torch.randn(4, 50)
    weights = torch.full((4, 50), -math.log(50))
    for _ in range(3):
        weights = torch.log_softmax(SequentialBayes()(weights, output, output), 1)
    torch.testing.assert_close(weights, torch.log_softmax(3 * output, 1))
