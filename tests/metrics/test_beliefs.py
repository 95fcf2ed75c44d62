"""Beliefs: entropy, spread and mass by hand; ranks of the truth are uniform where beliefs are
right, and only there.
"""

import math

import pytest
import torch
from torch import Generator

from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import random_rotation
from posefilter.geometry.spaces import PoseSpace
from posefilter.metrics.beliefs import entropy, mass_within, rank_of_truth, spread
from posefilter.metrics.collect import BeliefQuality
from posefilter.types import BeliefBatch, ObjectModel

SPACE = PoseSpace((0.0, 0.0, 0.05), 0.1)
CENTER = torch.tensor(SPACE.center)
POINTS = torch.randn(50, 3, generator=Generator().manual_seed(1)) * 0.05
MODEL = ObjectModel("thing", POINTS, CENTER, 0.1, 0.2, torch.eye(4)[None], POINTS)


def around(poses: torch.Tensor, sigma: float, count: int, g: Generator) -> torch.Tensor:
    scale = SPACE.noise_scale(torch.tensor(sigma))
    return SPACE.move(
        poses[:, None].expand(-1, count, 4, 4),
        scale * torch.randn(len(poses), count, 6, generator=g),
    )


def truths(count: int, g: Generator) -> torch.Tensor:
    return make_pose(random_rotation(count, generator=g), torch.randn(count, 3, generator=g))


def test_entropy_at_both_ends() -> None:
    log_w = torch.log(torch.tensor([[0.25] * 4, [1.0, 0, 0, 0], [0.5, 0.5, 0, 0]]))
    torch.testing.assert_close(entropy(log_w), torch.tensor([math.log(4), 0, math.log(2)]))


def test_spread_is_what_was_put_in() -> None:
    g = Generator().manual_seed(0)
    poses = around(truths(3, g), 0.01, 4000, g)
    shift, turn = spread(poses, torch.full((3, 4000), -math.log(4000)), SPACE)
    torch.testing.assert_close(shift, torch.full((3,), 0.01 * 3**0.5), rtol=0.03, atol=0)
    torch.testing.assert_close(turn, torch.full((3,), 0.1 * 3**0.5), rtol=0.03, atol=0)
    still = spread(poses[:, :1].expand(-1, 5, -1, -1), torch.full((3, 5), -math.log(5)), SPACE)
    assert max(still[0].max(), still[1].max()) < 2e-3


def test_mass_counts_weight_not_particles() -> None:
    truth = torch.eye(4)[None]
    poses = make_pose(torch.eye(3), torch.tensor([[[0.0, 0, 0], [0.015, 0, 0], [0.5, 0, 0]]]))
    log_w = torch.log(torch.tensor([[0.2, 0.3, 0.5]]))
    assert float(mass_within(poses, log_w, truth, POINTS, 0.01)) == pytest.approx(0.2)
    assert float(mass_within(poses, log_w, truth, POINTS, 0.02)) == pytest.approx(0.5)


def ranks(believed: float, real: float, images: int = 1500) -> torch.Tensor:
    """Ranks where the belief says that its center is off by `believed`, while it is off by
    `real`.
    """
    g = Generator().manual_seed(0)
    middle = truths(images, g)
    truth = around(middle, real, 1, g)[:, 0]
    poses = around(middle, 0.02, 60, g)
    # Particles are drawn broadly and weighted to be the belief: the weights must count.
    tangent = (SPACE.distance(poses, middle[:, None]) / 1.0).square()
    log_w = torch.log_softmax(-0.5 * tangent * (1 / believed**2 - 1 / 0.02**2), dim=1)
    return rank_of_truth(poses, log_w, truth, SPACE, chunk=50_000)


def test_ranks_are_uniform_for_calibrated_beliefs_and_not_for_vain_ones() -> None:
    right = ranks(0.018, 0.018)
    assert float(right.mean()) == pytest.approx(0.5, abs=0.06)
    assert float((right <= 0.9).float().mean()) == pytest.approx(0.9, abs=0.06)
    assert float((right <= 0.5).float().mean()) == pytest.approx(0.5, abs=0.08)
    vain = ranks(0.018, 0.05)
    assert float(vain.mean()) > 0.85
    timid = ranks(0.018, 0.006)
    assert float(timid.mean()) < 0.15


def test_the_collected_block() -> None:
    g = Generator().manual_seed(0)
    truth = truths(6, g)
    poses = around(truth, 0.002, 80, g)
    belief = BeliefBatch(poses, torch.full((6, 80), -math.log(80)), truth, torch.zeros(6))
    metric = BeliefQuality(MODEL)
    metric.update(BeliefBatch(*(x[:2] for x in belief)), truth[:2])
    metric.update(BeliefBatch(*(x[2:] for x in belief)), truth[2:])
    found = metric.compute()
    assert found["entropy"] == pytest.approx(math.log(80), rel=1e-4)
    assert found["effective_particles"] == pytest.approx(80, rel=1e-4)
    assert found["mass_01d"] == pytest.approx(1, abs=1e-3)
    assert found["mass_2cm"] == pytest.approx(1, abs=1e-3)
    assert found["rank"] < 0.1  # the truth is in the very middle of each
    assert found["distance_coverage_50"] == found["distance_coverage_90"] == 100
    metric.reset()
    metric.update(belief, truth.roll(1, 0))
    assert metric.compute()["mass_2cm"] == 0
    assert metric.compute()["distance_coverage_90"] == 0
