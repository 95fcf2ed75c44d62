"""The filter against the exact answer where there is one: a linear system with Gaussian noise
(Kalman 1960).
"""

import math

import pytest
import torch
from torch import Generator, Tensor

from posefilter.filters.estimate import Mean
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.propagate import Compose, Gaussian, LearnedDisplacement
from posefilter.filters.refine import NoRefine
from posefilter.filters.resample import (
    AdaptiveResampling,
    Multinomial,
    NoResampling,
    Soft,
    Stratified,
    Systematic,
)
from posefilter.filters.reweight import CurrentLikelihood, SequentialBayes
from posefilter.filters.schedule import Constant
from posefilter.filters.transport import EnsembleTransform, SampledTransport
from posefilter.geometry.spaces import PixelSpace
from posefilter.protocols import Propagate, Resample, Reweight
from posefilter.types import ParticleOutput, Particles, Resampled, Step, Trace

# x' = DRIFT x + MOVE n, y = x + SEEN n, x_0 ~ START n
DRIFT, MOVE, SEEN, START = 0.9, 0.5, 0.7, 2.0
OBSERVED = torch.tensor([0.5, 1.0, -0.3, 0.8, 1.9, 2.2])


class LinearGaussian:
    """A method whose likelihood and displacement are the toy system's; each axis of the pixel is
    one system.
    """

    space = PixelSpace()
    latent_width = 0

    def encode(self, batch: None) -> None:
        return None

    def measure(
        self, encoding: None, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        off = (OBSERVED[step.number] - particles.state) / SEEN
        log_p = (-0.5 * off.square() - math.log(SEEN) - 0.5 * math.log(2 * math.pi)).sum(-1)
        return ParticleOutput(
            log_p,
            (DRIFT - 1) * particles.state,
            torch.eye(4).expand(*log_p.shape, 4, 4),
            particles.latent,
        )


class Start:
    """Draws from the prior, for many filters side by side, so that what is random averages out."""

    def __init__(self, runs: int) -> None:
        self.runs = runs

    def __call__(
        self,
        batch: None,
        encoding: None,
        method: LinearGaussian,
        particles: int,
        generator: Generator,
    ) -> Tensor:
        return START * torch.randn(self.runs, particles, 2, generator=generator)


def kalman() -> tuple[float, float, float]:
    """Return the exact mean, standard deviation and log evidence of one axis."""
    mean, var, evidence = 0.0, START**2, 0.0
    for number, y in enumerate(OBSERVED.tolist()):
        if number:
            mean, var = DRIFT * mean, DRIFT**2 * var + MOVE**2
        total = var + SEEN**2
        evidence -= 0.5 * math.log(2 * math.pi * total) + 0.5 * (y - mean) ** 2 / total
        mean, var = mean + var / total * (y - mean), var * SEEN**2 / total
    return mean, math.sqrt(var), evidence


def run(
    resample: Resample,
    particles: int,
    runs: int = 32,
    reweight: Reweight | None = None,
    propagate: Propagate | None = None,
) -> Trace:
    move = propagate or Compose([LearnedDisplacement(), Gaussian(noise_scale=1.0)])
    pieces = (
        Start(runs),
        Constant(MOVE),
        reweight or SequentialBayes(),
        resample,
        move,
        Mean(),
        NoRefine(),
    )
    return ParticleFilter(particles, len(OBSERVED), *pieces)(
        None, LinearGaussian(), Generator().manual_seed(0)
    )


def errors(trace: Trace) -> Tensor:
    """Return how far mean, spread and evidence are from exact, each over what is random in them at
    this many particles.
    """
    particles = trace.particles[-1]
    weights = particles.log_weights.exp()[..., None]
    mean = (weights * particles.state).sum(1)
    var = (weights * (particles.state - mean[:, None]).square()).sum(1)
    evidence = trace.log_evidence.sum(1)
    m, s, e = kalman()
    runs = len(mean) ** 0.5
    return torch.stack(
        [
            (mean.mean() - m).abs() / (mean.std() / (2**0.5 * runs) + 0.002),
            (var.mean().sqrt() - s).abs() / (var.std() / (2 * s * 2**0.5 * runs) + 0.004),
            (evidence.exp().mean().log() - 2 * e).abs() / (evidence.std() / runs + 0.005),
        ]
    )


@pytest.mark.parametrize(
    ("resample", "particles", "runs"),
    [
        (Systematic(), 1500, 32),
        (Stratified(), 1500, 32),
        (Multinomial(), 1500, 32),
        (Soft(0.7), 3000, 32),
        (AdaptiveResampling(Systematic(), 0.5), 1500, 32),
        (AdaptiveResampling(Soft(0.5), 0.5), 3000, 32),
        (NoResampling(), 20000, 8),
        (SampledTransport(0.02, 25), 80, 16),
    ],
    ids=lambda x: type(x).__name__ if not isinstance(x, int) else str(x),
)
def test_mean_spread_and_evidence_are_kalmans(
    resample: Resample, particles: int, runs: int
) -> None:
    assert (errors(run(resample, particles, runs)) < 3.5).all()


def test_a_transported_ensemble_follows_kalman_a_little_too_sure() -> None:
    particles = run(EnsembleTransform(0.01, 25), 150, 8).particles[-1]
    m, s, _ = kalman()
    weights = particles.log_weights.exp()[..., None]
    mean = (weights * particles.state).sum(1, keepdim=True)
    spread = (weights * (particles.state - mean).square()).sum(1).mean().sqrt()
    assert (mean.mean() - m).abs() < 0.5 * s
    assert 0.75 * s < spread < 1.05 * s


class ForgetsWeights:
    """Planted defect: draw from the soft mixture, but let the children start alike."""

    def __call__(self, particles: Particles, *rest: object) -> Resampled:
        resampled = Soft(0.5)(particles, *rest)
        return resampled._replace(
            log_weights=torch.full_like(
                resampled.log_weights, -math.log(resampled.ancestors.shape[1])
            )
        )


class Greedy(Systematic):
    """Planted defect: draw by the squared weights."""

    def __call__(self, particles: Particles, *rest: object) -> Resampled:
        return super().__call__(
            particles._replace(log_weights=torch.log_softmax(2 * particles.log_weights, 1)), *rest
        )


@pytest.mark.parametrize(
    "broken",
    [
        {"resample": ForgetsWeights()},
        {"resample": Greedy()},
        {"resample": Systematic(), "propagate": LearnedDisplacement()},
        {"resample": Systematic(), "propagate": Gaussian(1.0)},
        {"resample": AdaptiveResampling(Systematic(), 0.05), "reweight": CurrentLikelihood()},
    ],
    ids=["weights forgotten", "greedy draw", "no noise", "no drift", "weights replaced"],
)
def test_the_law_catches_planted_defects(broken: dict) -> None:
    assert (errors(run(particles=1500, **broken)) > 3.5).any()


def test_kalman_itself_against_brute_force_on_a_grid() -> None:
    x = torch.linspace(-8, 8, 1601, dtype=torch.float64)
    dx = float(x[1] - x[0])
    normal = lambda d, s: torch.exp(-0.5 * (d / s) ** 2) / (s * math.sqrt(2 * math.pi))  # noqa: E731
    density, evidence = normal(x, START), 0.0
    for number, y in enumerate(OBSERVED.tolist()):
        if number:
            density = normal(x[:, None] - DRIFT * x, MOVE) @ density * dx
        density = density * normal(y - x, SEEN)
        evidence += math.log(float(density.sum()) * dx)
        density = density / (density.sum() * dx)
    mean = float((density * x).sum() * dx)
    spread = math.sqrt(float((density * (x - mean) ** 2).sum() * dx))
    assert (mean, spread, evidence) == pytest.approx(kalman(), abs=1e-5)
