"""Fragments of a surface: which one a point is in, how they spread, and what predictions cost."""

import math

import pytest
import torch

from posefilter.geometry.fragments import (
    fragment_errors,
    gather_fragment,
    init_fragments,
    nearest_fragment,
    sample_farthest_points,
    within_bounds,
)

CENTERS = torch.tensor([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]])


def test_a_point_is_in_the_fragment_of_the_nearest_center() -> None:
    points = torch.tensor([[0.4, 0.0, 0.0], [0.6, 0.0, 0.0], [0.0, 1.1, 5.0], [0.0, 0.9, -5.0]])
    assert nearest_fragment(points[None], CENTERS).tolist() == [[0, 1, 2, 0]]
    two = torch.cat([CENTERS, CENTERS + 1])
    apart = points.view(1, 2, 2, 3).expand(2, -1, -1, -1)
    found = nearest_fragment(apart, two)
    assert found.shape == (2, 2, 2)
    for b in range(2):
        want = torch.cdist(apart[b].reshape(-1, 3), two[b]).argmin(1)
        assert torch.equal(found[b].flatten(), want)


def test_positions_are_those_in_the_given_fragments() -> None:
    position = torch.arange(24.0).view(2, 4, 3)
    assert gather_fragment(position, torch.tensor([3, 0])).tolist() == [[9, 10, 11], [12, 13, 14]]


def test_the_farthest_points_of_a_line_are_its_ends_then_its_middle() -> None:
    line = torch.tensor([[x, 0.0, 0.0] for x in (0.0, 1.0, 2.0, 3.0, 4.2)])
    chosen, mean = sample_farthest_points(line, 3)
    assert chosen[:, 0].tolist() == pytest.approx([4.2, 0.0, 2.0])
    assert mean == pytest.approx((1.0 + 1.2 - 0.2) / 5)  # two points are left over, 1 m off each
    # the spread of too few points has a least value, for it is divided by
    assert sample_farthest_points(line[:1], 3)[1] == 0.001
    assert sample_farthest_points(line[:1], 3)[0].shape == (3, 3)


def test_points_up_to_a_fifth_beyond_the_ball_can_be_the_objects() -> None:
    far = torch.tensor([[1.19, 0.0, 0.0], [0.0, 1.21, 0.0], [0.9, 0.9, 0.0]])
    assert within_bounds(far).tolist() == [True, False, False]


def test_buffers_are_filled_once_in_radii_from_the_center() -> None:
    centers, reach = torch.zeros(2, 3), torch.zeros(())
    points = torch.tensor([[0.1, 0.0, 0.0], [0.3, 0.0, 0.0], [0.5, 0.0, 0.0]])
    init_fragments(centers, reach, points, torch.tensor([0.3, 0.0, 0.0]), 0.2)
    assert sorted(centers[:, 0].tolist()) == pytest.approx([-1.0, 1.0])
    assert float(reach) == pytest.approx(1 / 3)  # the middle one is 1 radius off, the others 0
    before = centers.clone()
    init_fragments(centers, reach, 2 * points, torch.zeros(3), 0.2)
    assert torch.equal(centers, before)


def test_errors_of_a_prediction_by_hand() -> None:
    """Of images, points and fragments of different numbers, so that no axis is like another."""
    truth = torch.tensor([[[0.1, 0.0, 0.0], [0.9, 0.0, 0.0]]]).repeat(1, 2, 1)  # fragments 0, 1
    share = torch.tensor([[0.5, 0.3, 0.2], [0.1, 0.7, 0.2], [0.2, 0.2, 0.6], [0.25, 0.5, 0.25]])
    position = truth[:, :, None] + torch.tensor(
        [[0.01, 0.02, -0.03], [0.0, -0.2, 0.1], [1.0, 1.0, 1.0]]
    )
    nll, error = fragment_errors(share.log()[None], position, CENTERS, 0.5, truth)
    assert nll[0].tolist() == pytest.approx([-math.log(p) for p in (0.5, 0.7, 0.2, 0.5)])
    assert error[0].tolist() == pytest.approx([0.12, 0.6, 0.12, 0.6])
