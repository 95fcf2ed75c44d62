"""Credible sets: what they hold, level by level and by visibility; how a belief sees a truth."""

import math

import numpy as np
import pytest
import torch
from tests.models.toy import square

from posefilter.belief import Belief
from posefilter.geometry.pose import make_pose
from posefilter.geometry.pose_density import fit_density, log_density, log_density_held_out
from posefilter.metrics.credibility import (
    LEVELS,
    Credibility,
    TruthScores,
    measure_coverage,
    score_truth,
    trace_curve,
)
from posefilter.types import BeliefBatch

NONE = torch.zeros(0, dtype=torch.float64)


def collect(rank: list[float], visible: list[float], density: list[float]) -> dict:
    metric = Credibility()
    numbers = torch.tensor(rank).double(), torch.tensor(visible)
    metric.update(TruthScores(torch.tensor(density).double(), numbers[0], numbers[0]), numbers[1])
    return metric.compute()


def test_a_set_holds_the_truths_whose_rank_is_below_its_level() -> None:
    """At a rank of 0.5 half of the belief is denser: the set of half the mass ends before it."""
    rank = torch.tensor([0.0, 0.25, 0.5, 1.0]).double()
    assert measure_coverage(rank, 0.5) == 0.5
    assert measure_coverage(rank, 0.51) == 0.75
    assert measure_coverage(rank, 0.25) == 0.25
    assert math.isnan(measure_coverage(NONE, 0.5))


def test_levels_are_every_twentieth_between_none_and_all() -> None:
    assert pytest.approx([k / 20 for k in range(1, 20)]) == LEVELS
    assert trace_curve(torch.tensor([0.42, 2.0])) == [0.0] * 8 + [0.5] * 11


def test_numbers_by_hand() -> None:
    found = collect([0.1, 0.6, 0.85, 0.99], [0.1, 0.25, 0.75, 1.0], [1.0, 2.0, 4.0, 9.0])
    assert found["log_density"] == 4
    assert found["log_density_p50"] == 3
    shown = [found[f"coverage_{percent}"] for percent in (50, 80, 90, 95)]
    assert shown == [25, 50, 75, 75]
    assert found["levels"] == list(LEVELS)
    assert found["all"][9] == 0.25
    # the lower end of a quarter is its own, and the last has both ends
    told = [(one["from"], one["to"], one["instances"]) for one in found["quarters"]]
    assert told == [(0.0, 0.25, 1), (0.25, 0.5, 1), (0.75, 1.0, 2)]
    assert [one["coverage"][-1] for one in found["quarters"]] == [1.0, 1.0, 0.5]


def test_a_share_that_is_not_known_is_in_no_quarter_and_no_image_has_no_numbers() -> None:
    found = collect([0.1], [math.nan], [1.0])
    assert found["quarters"] == []
    assert found["all"][-1] == 1.0
    assert Credibility().compute() == {}


def test_the_last_scores_are_told_as_they_came() -> None:
    metric = Credibility()
    for start in (0.0, 0.5):
        rows = torch.tensor([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]]).double() + start
        metric.update(TruthScores(*rows), torch.ones(2))
    assert torch.equal(torch.stack(list(metric.last())[:3]), rows)


def test_scores_by_the_density_itself() -> None:
    """A truth in the midst is denser than most of the belief, one far off is denser than none."""
    g = torch.Generator().manual_seed(0)
    shifts = 0.01 * torch.randn(80, 3, generator=g) + torch.tensor([0.0, 0.0, 0.8])
    poses = make_pose(torch.eye(3).expand(80, 3, 3), shifts)[None].expand(2, -1, -1, -1)
    truth = make_pose(torch.eye(3), torch.tensor([[0.0, 0.0, 0.8], [0.3, 0.0, 0.8]]))
    log_w = torch.randn(80, generator=g).log_softmax(0).expand(2, -1)
    belief = BeliefBatch(poses, log_w + 3.0, truth, torch.zeros(2))  # weights may be of any sum
    scores = score_truth(belief, truth, square())
    assert float(scores.rank[0]) < 0.3
    assert float(scores.rank[1]) == pytest.approx(1.0)
    model = square()
    density = fit_density(
        poses[0], log_w[0].double(), model.center, model.radius, model.diameter, model.symmetries
    )
    torch.testing.assert_close(scores.log_density, log_density(density, truth.double()))
    # the mean log density of the belief is the same, whatever the truth is
    means = scores.nonconformity + scores.log_density
    assert float(means[0]) == pytest.approx(float(means[1]))
    assert float(scores.nonconformity[0]) < 0 < float(scores.nonconformity[1])
    assert all(x.dtype == torch.float64 and x.shape == (2,) for x in scores)
    none = score_truth(BeliefBatch(*(x[:0] for x in belief)), truth[:0], square())
    assert [x.shape for x in none] == [(0,)] * 3


def test_the_share_that_is_counted_is_that_of_the_sets_themselves() -> None:
    """Truths between any two particles: 0.65 of 300 weights is a little less than 0.65."""
    generator = torch.Generator().manual_seed(3)
    samples = torch.eye(4).repeat(300, 1, 1).double()
    samples[:, :3, 3] = 0.01 * torch.randn(300, 3, generator=generator).double()
    even = torch.full((300,), 1 / 300).double()
    belief = Belief(samples.numpy(), even.numpy(), np.zeros(3), 0.1, 0.2)
    density = fit_density(samples, even.log(), torch.zeros(3), 0.1, 0.2)
    own, weights = log_density_held_out(density), density.log_weights.exp()
    ordered = own.sort(descending=True).values
    truths = (ordered[1:] + ordered[:-1]) / 2
    rank = torch.stack([weights @ (own > one).double() for one in truths])
    for level in LEVELS:
        held = truths >= belief.credible_set(level).min_log_density
        assert measure_coverage(rank, level) == float(held.double().mean())
