"""A last pass of importance sampling carries the posterior, whatever the search has left."""

import math
from typing import Any

import pytest
import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.filters.importance import ImportanceSampling, temper
from posefilter.filters.resample import effective_sample_size
from posefilter.geometry.pose import make_pose, move_about
from posefilter.geometry.pose_density import (
    draw_poses,
    fit_density,
    log_density,
    measure_kernels,
    widen,
)
from posefilter.geometry.pose_statistics import covariance_about, twist_between
from posefilter.geometry.rotation import exp_so3, random_rotation
from posefilter.geometry.spaces import PoseSpace
from posefilter.types import BeliefBatch

SCALE = torch.tensor([0.004, 0.003, 0.01, 0.03, 0.06, 0.04]).double()
CENTER = torch.tensor([0.02, -0.01, 0.03]).double()


class Known:
    """A method whose likelihood is a Gaussian of twists about the identity, x going with ry."""

    space = PoseSpace((0.02, -0.01, 0.03), 0.1)
    mix = torch.eye(6).double()
    mix[0, 4] = mix[4, 0] = 0.8
    covariance = SCALE[:, None] * mix * SCALE

    def score_poses(
        self, encoding: Any, poses: Tensor, sigma: float, generator: Generator, pixels: int
    ) -> Tensor:
        twist = twist_between(torch.eye(4).double(), poses.double(), CENTER)
        square = (twist @ torch.linalg.inv(self.covariance) * twist).sum(-1)
        return (-0.5 * square).float()


def search_result(width: float = 0.7, count: int = 200) -> BeliefBatch:
    """Return what a search leaves: too narrow, beside the middle, without the correlation."""
    g = torch.Generator().manual_seed(0)
    twist = (torch.randn(1, count, 6, generator=g).double() + 0.4) * width * SCALE
    poses = move_about(torch.eye(4).double().expand(1, count, 4, 4), twist, CENTER)
    even = torch.full((1, count), -math.log(count))
    return BeliefBatch(poses.float(), even, poses[:, 0].float(), torch.tensor([3.0]))


def moments(belief: BeliefBatch) -> tuple[Tensor, Tensor]:
    weights = belief.log_weights[0].double().exp()
    poses, origin = belief.poses[0].double(), torch.eye(4).double()
    mean = (weights[:, None] * twist_between(origin, poses, CENTER)).sum(0)
    return mean, covariance_about(origin, poses, weights, CENTER)


@pytest.mark.parametrize(
    ("options", "temperature"), [({}, 1.0), ({"temperature": 2.0}, 2.0)], ids=["default", "hot"]
)
def test_the_new_particles_have_the_moments_of_the_posterior(
    options: dict[str, float], temperature: float
) -> None:
    before = search_result()
    sampling = ImportanceSampling(400, rounds=2, **options)  # type: ignore[arg-type]
    after = sampling(before, None, Known(), torch.Generator().manual_seed(1))  # type: ignore[arg-type]
    mean, covariance = moments(after)
    scale = SCALE * math.sqrt(temperature)
    assert bool((mean.abs() < 0.3 * scale).all())
    assert bool(((covariance.diagonal().sqrt() / scale - 1).abs() < 0.25).all())
    deviation = covariance.diagonal().sqrt()
    assert float(covariance[0, 4] / deviation[0] / deviation[4]) == pytest.approx(0.8, abs=0.12)
    old = moments(before)[1]
    assert float(old[0, 4] / old[0, 0].sqrt() / old[4, 4].sqrt()) < 0.5
    assert float(after.log_weights.logsumexp(1)) == pytest.approx(0, abs=1e-5)
    assert torch.equal(after.best, before.best)
    assert torch.equal(after.score, before.score)


def test_the_same_seed_gives_the_same_particles() -> None:
    one, other = (
        ImportanceSampling(50, 1)(search_result(), None, Known(), torch.Generator().manual_seed(s))  # type: ignore[arg-type]
        for s in (2, 2)
    )
    assert torch.equal(one.poses, other.poses)
    assert torch.equal(one.log_weights, other.log_weights)


def test_drawn_poses_are_of_the_density_they_are_drawn_from() -> None:
    """The mean of p / q over draws from q is 1, for a narrower p."""
    g = torch.Generator().manual_seed(3)
    start = make_pose(random_rotation(generator=g), torch.randn(3, generator=g)).double()
    noise = torch.randn(60, 6, generator=g).double() * SCALE
    poses = move_about(start.expand(60, 4, 4), noise, CENTER)
    even = torch.full((60,), -math.log(60)).double()
    density = fit_density(poses, even, CENTER, 0.1, 0.2)
    wide = widen(density, 1.5)
    drawn = draw_poses(wide, 4000, g)
    ratio = (log_density(density, drawn) - log_density(wide, drawn)).exp()
    assert float(ratio.mean()) == pytest.approx(1, abs=0.06)
    assert torch.allclose(measure_kernels(wide), 2.25 * measure_kernels(density), rtol=1e-6)


def test_widened_turns_end_before_they_wrap_round() -> None:
    turns = exp_so3(torch.randn(40, 3, generator=torch.Generator().manual_seed(4)).double())
    poses = make_pose(turns, torch.zeros(3).double())
    even = torch.full((40,), -math.log(40)).double()
    density = widen(fit_density(poses, even, torch.zeros(3).double(), 0.1, 0.2), 10.0)
    size = torch.linalg.eigvalsh(measure_kernels(density)[:, 3:, 3:])
    assert float(size.max()) <= 0.6**2 + 1e-6


@pytest.mark.parametrize(
    "wrong",
    [
        {"samples": 0}, {"rounds": 0}, {"widening": 0.5}, {"temperature": 0.0},
        {"sigma": 0.0}, {"pixels": 0}, {"min_effective": 2.0}, {"min_effective": -0.1},
    ],
)  # fmt: skip
def test_numbers_out_of_range_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(UserError, match="importance sampling needs"):
        ImportanceSampling(**wrong)  # type: ignore[arg-type]


def test_only_the_density_of_the_search_is_widened() -> None:
    seen: list[float] = []

    class Watched(ImportanceSampling):
        def propose(
            self, poses: Tensor, weights: Tensor, method: Any, widening: float, generator: Generator
        ) -> tuple[Tensor, Tensor]:
            seen.append(widening)
            return super().propose(poses, weights, method, widening, generator)

    Watched(20, 3, widening=1.5)(search_result(), None, Known(), Generator().manual_seed(0))  # type: ignore[arg-type]
    assert seen == [1.5, 1.0, 1.0]


def test_kernels_are_of_their_own_mode_though_it_has_few_poses() -> None:
    """Three images of two modes with twenty poses each, half a turn apart: a kernel over both would
    seldom hit one, and few of its draws would have any weight.
    """
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    half = make_pose(turn, CENTER - turn @ CENTER)

    class Two(Known):
        def score_poses(self, encoding: Any, poses: Tensor, *rest: Any) -> Tensor:
            ends = torch.stack([poses.double(), poses.double() @ half])
            return super().score_poses(encoding, ends, *rest).logsumexp(0)

    g = torch.Generator().manual_seed(0)
    noise = torch.randn(3, 40, 6, generator=g).double() * SCALE
    poses = move_about(torch.eye(4).double().expand(3, 40, 4, 4), noise, CENTER)
    poses[:, 20:] = poses[:, 20:] @ half
    before = BeliefBatch(poses, torch.full((3, 40), -math.log(40)), poses[:, 0], torch.zeros(3))
    after = ImportanceSampling(400, 1, widening=1.0)(before, None, Two(), g)  # type: ignore[arg-type]
    assert float((-after.log_weights.mul(2).logsumexp(1)).exp().mean()) > 35


def test_tempered_rounds_weigh_a_narrow_mode_as_its_mass() -> None:
    """Two modes of equal mass, one half as wide, the search's particles wider than both: without
    tempering the narrow one's few good particles decide its fate.
    """
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    half = make_pose(turn, CENTER - turn @ CENTER)

    class Unlike(Known):
        def score_poses(self, encoding: Any, poses: Tensor, *rest: Any) -> Tensor:
            wide = super().score_poses(encoding, poses, *rest).double()
            narrow = super().score_poses(encoding, poses.double() @ half, *rest).double() / 0.5**2
            return torch.logaddexp(wide, narrow - 6 * math.log(0.5)).float()

    worst = {}
    for least in (0.0, 0.2):
        masses = []
        for seed in range(8):
            g = Generator().manual_seed(seed)
            noise = torch.randn(1, 200, 6, generator=g).double() * SCALE * 1.5
            poses = move_about(torch.eye(4).double().expand(1, 200, 4, 4), noise, CENTER)
            poses[:, 100:] = poses[:, 100:] @ half
            even = torch.full((1, 200), -math.log(200))
            before = BeliefBatch(poses, even, poses[:, 0], torch.zeros(1))
            sampling = ImportanceSampling(400, 5, widening=1.0, min_effective=least)
            after = sampling(before, None, Unlike(), g)  # type: ignore[arg-type]
            masses.append(float(((after.poses[:, :, 2, 2] < 0) * after.log_weights.exp()).sum()))
        worst[least] = max(abs(mass - 0.5) for mass in masses)
    assert worst[0.2] < 0.15
    assert worst[0.0] > 0.3


def test_weights_are_tempered_as_little_as_is_needed() -> None:
    uneven = torch.tensor([[0.0, -5.0, -50.0, -math.inf], [0.0, 0.0, 0.0, 0.0]]).log_softmax(1)
    tempered = temper(uneven, 0.5)
    assert float(effective_sample_size(tempered)[0]) == pytest.approx(2, rel=1e-4)
    torch.testing.assert_close(tempered[1], uneven[1])
    torch.testing.assert_close(temper(uneven, 0.0)[:, :3], uneven[:, :3])
    assert temper(torch.tensor([[0.0, -math.inf, -math.inf]]), 1.0).isfinite().all()
