"""Auxiliary weights of objectness move children, not the belief."""

import pytest
import torch

from posefilter.errors import UserError
from posefilter.filters.auxiliary import AuxiliaryResampling, gather_objectness
from posefilter.filters.resample import Systematic
from posefilter.geometry.spaces import PixelSpace
from posefilter.types import Particles


class Relevant:
    def __init__(self, objectness: torch.Tensor) -> None:
        self.objectness = objectness


def cloud_of(N: int, seed: int) -> Particles:
    g = torch.Generator().manual_seed(seed)
    state = torch.rand(2, N, 2, generator=g) * torch.tensor([79.0, 59.0])
    weights = torch.randn(2, N, generator=g).log_softmax(1)
    return Particles(state, torch.zeros(2, N, 0), weights, torch.arange(N).expand(2, N))


def test_sampling_takes_the_cell_under_the_particle() -> None:
    objectness = torch.arange(6.0).view(1, 1, 2, 3)
    state = torch.tensor([[[-0.5, -0.5], [9.4, 9.4], [9.6, 9.4], [29.0, 19.0], [500.0, -70.0]]])
    assert gather_objectness(objectness, state, 20, 30).tolist() == [[0.0, 0.0, 1.0, 5.0, 2.0]]


def test_auxiliary_resampling_keeps_the_weighted_mean_and_prefers_the_object() -> None:
    particles = cloud_of(40, 0)
    objectness = torch.full((2, 1, 6, 8), 0.1)
    objectness[..., :4] = 1.0  # the left half
    draw = AuxiliaryResampling(Systematic()).bind(Relevant(objectness), 60, 80)
    truth = (particles.log_weights.exp()[..., None] * particles.state).sum(1)
    g = torch.Generator().manual_seed(1)
    resampled = draw(particles, 20000, PixelSpace(), g)
    picked = particles.state.gather(1, resampled.ancestors[..., None].expand(-1, -1, 2))
    mean = (resampled.log_weights.exp()[..., None] * picked).sum(1)
    torch.testing.assert_close(mean, truth, atol=0.05, rtol=0)
    left = picked[..., 0] < 39.5
    assert left.float().mean() > 0.8
    # the canary: without the weights, the mean is wrong
    assert (picked.mean(1) - truth).norm(dim=-1).min() > 5
    torch.testing.assert_close(
        resampled.log_weights.logsumexp(1), torch.zeros(2), atol=1e-4, rtol=0
    )


def test_auxiliary_resampling_needs_a_map() -> None:
    with pytest.raises(UserError, match="bound"):
        AuxiliaryResampling(Systematic())(cloud_of(4, 0), 4, PixelSpace(), torch.Generator())
