"""Figures of tracks: gaps are counted, and jitter is what changes, not what is off."""

import math

import pytest
import torch

from posefilter.geometry.spaces import PoseSpace
from posefilter.metrics.tracks import Gap, find_gaps, measure_jitter

CENTER = (0.01, 0.0, 0.02)
SPACE = PoseSpace(CENTER, 0.1)


def test_gaps_are_found_with_their_ends() -> None:
    tracked = [bool(int(x)) for x in "0110001011"]
    assert find_gaps(tracked) == [Gap(0, 1, True), Gap(3, 3, True), Gap(7, 1, True)]
    assert find_gaps([True, False, False]) == [Gap(1, 2, False)]
    assert find_gaps([True, True]) == find_gaps([]) == []


def test_jitter_is_the_change_of_the_error() -> None:
    """A constant offset has none, whatever the motion; an alternating one is measured exactly."""
    g = torch.Generator().manual_seed(0)
    truth = SPACE.move(
        torch.eye(4).double().expand(6, 4, 4), torch.randn(6, 6, generator=g).double()
    )
    offset = SPACE.move(torch.eye(4).double(), torch.tensor([0.01, 0, 0, 0, 0.2, 0]).double())
    center = torch.tensor(CENTER).double()
    assert measure_jitter(truth @ offset, truth, center) == pytest.approx((0, 0), abs=1e-5)
    twist = torch.zeros(6, 6).double()
    twist[1::2, 2], twist[1::2, 4] = 0.003, math.radians(2)
    errors = SPACE.move(torch.eye(4).double().expand(6, 4, 4), twist)
    assert measure_jitter(truth @ errors, truth, center) == pytest.approx((3, 2), rel=1e-6)
    assert all(math.isnan(x) for x in measure_jitter(truth[:1], truth[:1], center))
