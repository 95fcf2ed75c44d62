"""Kernels over poses: their shapes by hand, and poses that are drawn from them in even strata."""

import math

import pytest
import torch

from posefilter.geometry.camera import intrinsics, project
from posefilter.geometry.pose import make_pose, move_about
from posefilter.geometry.pose_density import draw_poses, fit_density, log_density
from posefilter.geometry.pose_kernels import (
    measure_modes,
    measure_neighbors,
    split_poses,
    whiten_kernels,
)
from posefilter.geometry.rotation import exp_so3

CENTER = torch.tensor([0.02, 0.0, -0.01]).double()
UNIT = torch.tensor([1.0, 1.0, 1.0, 0.1, 0.1, 0.1]).double()


def line_of(shifts: list[float], axis: int = 0) -> torch.Tensor:
    twist = torch.zeros(len(shifts), 6).double()
    twist[:, axis] = torch.tensor(shifts).double()
    return move_about(torch.eye(4).double().expand(len(shifts), 4, 4), twist, CENTER)


def blunted(variance: float, axis: int) -> torch.Tensor:
    """Return a covariance along one axis, a twentieth of which has no direction."""
    whole = torch.zeros(6).double()
    whole[axis] = 0.95 * variance
    return torch.diag(whole + 0.05 * variance / 6)


@pytest.mark.parametrize("axis", [0, 1, 2, 3, 5])
def test_a_line_of_neighbors_gives_a_kernel_along_it(axis: int) -> None:
    """Of five poses a step apart, about their mean: the middle one's three nearest have two thirds
    of a step squared, all five have two.
    """
    step = 0.01
    parts = split_poses(line_of([-2 * step, -step, 0.0, step, 2 * step], axis), CENTER)
    even = torch.full((5,), 0.2).double()
    three, five = measure_neighbors(parts, even, [3, 5], UNIT)
    scale = 1.0 if axis < 3 else 0.01  # a turn counts by the radius
    square = scale * step**2
    torch.testing.assert_close(three[2], blunted(2 / 3 * square, axis), atol=1e-9, rtol=1e-4)
    torch.testing.assert_close(five[2], blunted(2 * square, axis), atol=1e-9, rtol=1e-4)
    torch.testing.assert_close(five[0], five[4], atol=1e-9, rtol=1e-4)


def test_weights_count_and_the_lightest_a_little() -> None:
    """A hundredth of the greatest weight is added to each."""
    parts = split_poses(line_of([0.0, 0.03]), CENTER)
    weights = torch.tensor([1.0, 0.0]).double()
    light = 0.01 / 1.02
    wide = light * (1 - light) * 0.03**2
    found = measure_neighbors(parts, weights, [2], UNIT)[0][0]
    torch.testing.assert_close(found, blunted(wide, 0), atol=1e-10, rtol=1e-4)


def test_the_shape_of_a_mode_is_its_own_where_it_has_many_poses() -> None:
    """Two modes of two equal poses each, of one degree of freedom: eight count for the common
    one, so that a ninth is a mode's own.
    """
    poses = torch.cat([line_of([0.0, 0.02]), line_of([1.0, 1.04], 1)])
    even = torch.full((4,), 0.25).double()
    member = torch.tensor([0, 0, 1, 1])
    found = measure_modes(split_poses(poses, CENTER), even, member, UNIT)
    assert torch.equal(found[0], found[1])
    own = [0.01**2, 0.02**2]
    for mode, row in ((0, 0), (1, 2)):
        shares = [(1 / 9) * (mode == k) + (8 / 9) / 2 for k in (0, 1)]
        variance = [share * v for share, v in zip(shares, own, strict=True)]
        want = 0.95 * torch.diag(torch.tensor([*variance, 0, 0, 0, 0]).double())
        want += 0.05 * sum(variance) / 6 * torch.eye(6)
        torch.testing.assert_close(found[row], want, atol=1e-10, rtol=1e-4)
    # a number that no pose has is no mode
    skipped = measure_modes(split_poses(poses, CENTER), even, 2 * member, UNIT)
    torch.testing.assert_close(skipped, found)


def test_whitened_kernels_are_normal_densities() -> None:
    g = torch.Generator().manual_seed(0)
    root = 0.05 * torch.randn(3, 6, 6, generator=g).double()
    covariance = root @ root.mT + 1e-4 * torch.eye(6)
    whiten, log_scale = whiten_kernels(covariance)
    for k in range(3):
        normal = torch.distributions.MultivariateNormal(torch.zeros(6).double(), covariance[k])
        twist = 0.1 * torch.randn(6, generator=g).double()
        found = log_scale[k] - 0.5 * (whiten[k] @ twist).square().sum()
        assert float(found) == pytest.approx(float(normal.log_prob(twist)))


def test_each_of_even_kernels_is_drawn_once_in_as_many_draws() -> None:
    """One uniform number decides where all strata are hit, so that none is missed."""
    poses = line_of([0.0, 1.0, 2.0, 3.0, 4.0])
    even = torch.full((5,), -math.log(5)).double()
    density = fit_density(poses, even, CENTER, 0.1, 0.2, member=torch.arange(5))
    near = density._replace(whiten=1e4 * torch.eye(6).double().expand(5, 6, 6))
    for seed in range(8):
        drawn = draw_poses(near, 5, torch.Generator().manual_seed(seed))
        assert sorted(round(x) for x in drawn[:, 0, 3].tolist()) == [0, 1, 2, 3, 4]
    weighted = near._replace(log_weights=torch.tensor([0.5, 0.0, 0.0, 0.25, 0.25]).double().log())
    drawn = draw_poses(weighted, 8, torch.Generator().manual_seed(0))
    assert sorted(round(x) for x in drawn[:, 0, 3].tolist()) == [0, 0, 0, 0, 3, 3, 4, 4]
    # noise of a kernel has its size
    wide = near._replace(whiten=50 * torch.eye(6).double().expand(5, 6, 6))
    drawn = draw_poses(wide, 4000, torch.Generator().manual_seed(1))
    off = drawn[:, 0, 3] - drawn[:, 0, 3].round()
    assert float(off.std()) == pytest.approx(0.02, rel=0.05)


def test_far_from_all_kernels_the_background_is_left() -> None:
    """Cauchy in three dimensions about the mean, any rotation: a hundredth of the mass."""
    poses = line_of([-0.001, 0.0, 0.001])
    density = fit_density(poses, torch.full((3,), -math.log(3)).double(), CENTER, 0.1, 0.2)
    for far in (0.4, 2.0):
        at = make_pose(exp_so3(torch.tensor([0.0, 2.0, 0.0]).double()), torch.zeros(3).double())
        at[:3, 3] = CENTER - at[:3, :3] @ CENTER + torch.tensor([0.0, far, 0.0])
        ratio = (far / 0.2) ** 2
        cauchy = 1 / (math.pi**2 * 0.2**3 * (1 + ratio) ** 2)
        want = math.log(0.01 * cauchy / math.pi**2)
        assert float(log_density(density, at[None])[0]) == pytest.approx(want, abs=1e-6)


def test_a_camera_matrix_has_no_skew() -> None:
    K = intrinsics(100.0, 200.0, 30.0, 40.0)
    assert K.tolist() == [[100, 0, 30], [0, 200, 40], [0, 0, 1]]
    assert project(torch.tensor([[0.0, 1.0, 2.0]]), K).tolist() == [[30, 140]]
    # what is nearer than 1 mm is projected as at 1 mm
    assert project(torch.tensor([[1e-4, 0.0, 1e-4]]), K)[0, 0].item() == pytest.approx(40)
