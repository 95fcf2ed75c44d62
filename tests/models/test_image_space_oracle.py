"""The filter itself is not what fails: told the truth about where to go, its particles reach the
object.
"""

import pytest
import torch
from torch import Generator, Tensor

from posefilter.filters.estimate import Argmax
from posefilter.filters.initialize import UniformPixels
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.propagate import LearnedDisplacement
from posefilter.filters.refine import NoRefine
from posefilter.filters.resample import NoResampling, Systematic
from posefilter.filters.reweight import CurrentLikelihood
from posefilter.filters.schedule import Constant
from posefilter.geometry.lookup import nearest_mask_pixel
from posefilter.geometry.spaces import PixelSpace
from posefilter.metrics.beliefs import on_object
from posefilter.metrics.diagnostics import FilterDiagnostics
from posefilter.nets.heads import Bounded, Unbounded
from posefilter.types import Batch, ParticleOutput, Particles, Step

H, W = 60, 80


class Told:
    """Knows the mask, and moves each particle by `answer` times what it should."""

    space = PixelSpace()
    latent_width = 0

    def __init__(self, mask: Tensor, head: torch.nn.Module, answer: str) -> None:
        self.mask, self.head, self.answer = mask, head, answer

    def encode(self, batch: Batch) -> None:
        return None

    def measure(
        self, encoding: None, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        way = nearest_mask_pixel(self.mask, particles.state) - particles.state
        if self.answer == "mean":
            way = way.mean((0, 1)).expand_as(way)
        raw = (
            way / (W / 2)
            if isinstance(self.head, Unbounded)
            else torch.atanh((way / (0.25 * W)).clamp(-0.999, 0.999))
        )
        flat = torch.zeros_like(particles.log_weights)
        displacement = self.head(raw, flat, particles.state, W, H)
        pose = torch.eye(4).expand(*flat.shape, 4, 4)
        return ParticleOutput(flat, displacement, pose, particles.latent)


def scenes() -> Batch:
    mask = torch.zeros(3, 1, H, W, dtype=torch.bool)
    mask[0, 0, 5:15, 60:75] = True
    mask[1, 0, 40:59, 0:12] = True
    mask[2, 0, 25:40, 30:50] = True
    zeros = torch.zeros(3, dtype=torch.int64)
    rgb, depth = torch.zeros(3, 3, H, W), torch.ones(3, 1, H, W)
    return Batch(
        rgb,
        depth,
        mask,
        torch.eye(3).expand(3, 3, 3),
        torch.eye(4).expand(3, 4, 4),
        zeros,
        zeros,
        torch.ones(3),
    )


@pytest.mark.parametrize("resample", [NoResampling(), Systematic()], ids=["never", "systematic"])
@pytest.mark.parametrize("head", [Unbounded(), Bounded(0.25)], ids=["unbounded", "bounded"])
def test_with_true_displacements_every_particle_reaches_the_object(
    head: torch.nn.Module, resample: NoResampling
) -> None:
    batch = scenes()
    pieces = (
        UniformPixels(),
        Constant(0.0),
        CurrentLikelihood(),
        resample,
        LearnedDisplacement(),
        Argmax(),
        NoRefine(),
    )
    pixel_filter = ParticleFilter(100, 8, *pieces)
    trace = pixel_filter(batch, Told(batch.mask, head, "truth"), Generator().manual_seed(0))
    assert on_object(batch.mask, trace.particles[0].state).max() < 0.3
    assert on_object(batch.mask, trace.particles[-1].state).min() == 1.0
    signs = FilterDiagnostics()
    signs.update(trace, batch)
    found = signs.compute()
    assert found["offset_cosine"] > 0.99
    assert found["off_frame"] == [0.0] * 8
    assert found["on_object"][-1] == 1.0


def test_with_mean_displacements_they_drift_together_and_miss() -> None:
    """What a network that sees nothing of use can learn at best: the signs tell it from the
    truth.
    """
    batch = scenes()
    pieces = (
        UniformPixels(),
        Constant(0.0),
        CurrentLikelihood(),
        NoResampling(),
        LearnedDisplacement(),
        Argmax(),
        NoRefine(),
    )
    trace = ParticleFilter(100, 8, *pieces)(
        batch, Told(batch.mask, Unbounded(), "mean"), Generator().manual_seed(0)
    )
    signs = FilterDiagnostics()
    signs.update(trace, batch)
    found = signs.compute()
    assert found["pairwise_cosine"] > 0.99
    assert found["offset_r2"] < 0.05
    assert len(found["near_edge"]) == 8
    assert on_object(batch.mask, trace.particles[-1].state).mean() < 0.5
