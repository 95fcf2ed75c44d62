"""Figure 5 as numbers: points along rays are told apart by where they lie and by their color."""

from collections.abc import Callable
from types import ModuleType

import pytest
import torch

from posefilter.filters.loop import make_particles
from posefilter.models.candidate_samplers import one_step_trace
from posefilter.types import ParticleOutput


@pytest.fixture
def points(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """Return the script."""
    return load_script("bench/point_scores.py")


def test_points_are_told_apart_and_padding_is_left_out(points: ModuleType) -> None:
    offset = torch.tensor([0.005, -0.005, -0.2, 0.02, 0.03, 0.0])  # [m] behind the surface
    own = torch.tensor([1.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    state = torch.stack([torch.zeros(6), torch.zeros(6), offset, own], dim=-1)[None]
    weights = torch.tensor([[1.0, 1.0, 1.0, 1.0, 1.0, 0.0]]).log()
    particles = make_particles(state, 0)._replace(log_weights=weights)
    scores = torch.arange(1.0, 7.0)[None]
    pose = torch.eye(4).expand(1, 6, 4, 4)
    output = ParticleOutput(scores, torch.zeros(1, 6, 6), pose, particles.latent)
    found = points.sort_points(one_step_trace(particles, output, torch.tensor([0.01])), 0.01)
    assert [one.tolist() for one in found.values()] == [[1.0], [2.0], [3.0], [4.0, 5.0]]
    last = points.format_table(found).splitlines()[-1]
    assert "| -100 | 2 | 4.5 |" in last
    assert "-115.43" in last
