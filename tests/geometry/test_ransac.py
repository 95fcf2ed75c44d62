"""RANSAC over 3-D to 3-D correspondences: planted poses, outliers, and what a refit may not do."""

import pytest
import torch
from torch import Tensor

from posefilter.geometry.pose import make_pose, transform
from posefilter.geometry.ransac import (
    agreement,
    draw_minimal_fits,
    refit_to_inliers,
    weigh_inliers,
)
from posefilter.geometry.rotation import random_rotation

TOLERANCE = 0.01


def plant(
    outliers: float, noise: float = 0.0, count: int = 5, n: int = 200
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return poses, and correspondences of which a share is drawn anywhere in the same volume."""
    g = torch.Generator().manual_seed(0)
    pose = make_pose(random_rotation(count, generator=g), torch.tensor([0.1, -0.1, 0.8]))
    source = (torch.rand(count, n, 3, generator=g) - 0.5) * 0.2
    target = transform(pose, source) + noise * torch.randn(count, n, 3, generator=g)
    wrong = (torch.rand(count, n, 3, generator=g) - 0.5) * 0.3 + pose[:, None, :3, 3]
    bad = torch.arange(n) < outliers * n
    return pose, source, torch.where(bad[None, :, None], wrong, target), torch.ones(count, n)


def find_best(
    source: Tensor, target: Tensor, weights: Tensor, count: int = 200, rounds: int = 2
) -> tuple[Tensor, Tensor]:
    poses = draw_minimal_fits(source, target, weights, count, torch.Generator().manual_seed(1))
    poses = refit_to_inliers(poses, source, target, weights, TOLERANCE, rounds)
    share, index = weigh_inliers(agreement(poses, source, target, TOLERANCE), weights).max(1)
    return poses[torch.arange(len(poses)), index], share


@pytest.mark.parametrize("outliers", [0.0, 0.5, 0.7])
def test_a_planted_pose_is_found_among_outliers(outliers: float) -> None:
    pose, source, target, weights = plant(outliers)
    best, share = find_best(source, target, weights)
    torch.testing.assert_close(best, pose, atol=1e-4, rtol=0)
    # a wrong correspondence agrees by chance where it is drawn next to the right place
    right = (1 - outliers) * 200 / 200.5
    assert ((share >= right - 1e-3) & (share < right + 0.03)).all()


def test_one_fit_of_all_correspondences_fails_where_ransac_does_not() -> None:
    """So that the test above tests RANSAC."""
    pose, source, target, weights = plant(0.5)
    everything = refit_to_inliers(pose[:, None], source, target, weights, 10.0, 1)[:, 0]
    assert (everything - pose).abs().amax((1, 2)).min() > 0.01


def test_refits_average_the_noise_and_lose_no_inlier() -> None:
    pose, source, target, weights = plant(0.5, noise=0.003)
    rough, before = find_best(source, target, weights, rounds=0)
    fine, after = find_best(source, target, weights, rounds=3)
    assert (after >= before).all()
    off = lambda found: (found[:, :3, 3] - pose[:, :3, 3]).norm(dim=-1)  # noqa: E731
    assert off(fine).mean() < 0.5 * off(rough).mean()
    assert off(fine).max() < 0.002


def test_weights_say_which_correspondences_count() -> None:
    """Outliers without weight are neither drawn nor counted, however many they are."""
    pose, source, target, weights = plant(0.97)
    weights = weights * (torch.arange(200) >= 0.97 * 200)
    best, share = find_best(source, target, weights, count=1, rounds=0)
    torch.testing.assert_close(best, pose, atol=1e-3, rtol=0)
    torch.testing.assert_close(share, torch.full((5,), 6 / 6.5))


def test_an_image_without_any_weight_has_no_share_and_a_finite_pose() -> None:
    _, source, target, weights = plant(0.5)
    best, share = find_best(source, target, 0 * weights, count=4)
    assert bool(best.isfinite().all())
    assert share.tolist() == [0.0] * 5


def test_three_inliers_are_enough_to_fit_again_and_two_are_not() -> None:
    """Corners of a triangle 5 mm off: a fit to the three is exact, one to two is not tried."""
    source = torch.tensor([[[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.5, 0.5, 0.5]]])
    target = source.clone()
    target[0, 3] += 1.0
    rough = torch.eye(4)[None, None].clone()
    rough[..., 0, 3] = 0.005
    weights = torch.ones(1, 4)
    fitted = refit_to_inliers(rough, source, target, weights, TOLERANCE, 1)
    torch.testing.assert_close(fitted[0, 0], torch.eye(4), atol=1e-5, rtol=0)
    target[0, 2] += 1.0
    assert torch.equal(refit_to_inliers(rough, source, target, weights, TOLERANCE, 1), rough)
    assert torch.equal(refit_to_inliers(rough, source, source, weights, TOLERANCE, 0), rough)


def test_what_agrees_is_nearer_than_the_tolerance_and_counts_by_its_weight() -> None:
    source = torch.zeros(1, 3, 3)
    target = torch.tensor([[[0.0, 0, 0], [0.006, 0.0, 0.007], [0.0, 0.008, 0.008]]])
    inside = agreement(torch.eye(4)[None, None], source, target, TOLERANCE)
    assert inside.tolist() == [[[True, True, False]]]
    weights = torch.tensor([[1.0, 0.25, 0.25]])
    assert weigh_inliers(inside, weights).item() == pytest.approx(1.25 / 2)
    assert weigh_inliers(inside, weights, few=1.0).item() == pytest.approx(1.25 / 2.5)
