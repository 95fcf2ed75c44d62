"""Markov moves of the particles leave the posterior unchanged, and find its modes."""

import math
from typing import Any

import pytest
import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.filters.resample_move import ResampleMove, draw_differences
from posefilter.geometry.pose import make_pose, move_about, origin_of, rotation_of
from posefilter.geometry.pose_statistics import twist_between
from posefilter.geometry.rotation import angle_between, exp_so3
from posefilter.geometry.spaces import PoseSpace
from posefilter.types import BeliefBatch

SHIFT, TURN = 0.004, 0.05
CENTER = torch.tensor([0.02, -0.01, 0.03]).double()
HALF = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
RUNS, COUNT = 200, 60


class TwoModes:
    """A likelihood with modes of the masses `mass` and 1 - `mass`, a half turn about x apart."""

    space = PoseSpace((0.02, -0.01, 0.03), 0.1)

    def __init__(self, mass: float) -> None:
        self.mass = mass

    def score_poses(
        self, encoding: Any, poses: Tensor, sigma: float, generator: Generator, pixels: int
    ) -> Tensor:
        assert poses.numel()  # networks need not take none
        far = (origin_of(poses, CENTER) - CENTER).square().sum(-1) / SHIFT**2
        modes = torch.stack([torch.eye(3).double(), HALF])
        angle = angle_between(rotation_of(poses)[..., None, :, :], modes) / TURN
        masses = torch.tensor([self.mass, 1 - self.mass]).double()
        return (masses.log() - 0.5 * angle.square()).logsumexp(-1) - 0.5 * far


def draw(share: float, width: float = 1.0, runs: int = RUNS) -> BeliefBatch:
    """Return `runs` beliefs: each particle in the first mode with probability `share`."""
    g = torch.Generator().manual_seed(0)
    first = torch.rand(runs, COUNT, generator=g) < share
    turn = torch.where(first[..., None, None], torch.eye(3).double(), HALF)
    mode = make_pose(turn, CENTER - turn @ CENTER)
    noise = torch.randn(runs, COUNT, 6, generator=g).double()
    poses = move_about(mode, width * noise * torch.tensor([SHIFT] * 3 + [TURN] * 3), CENTER)
    even = torch.full((runs, COUNT), -math.log(COUNT)).double()
    return BeliefBatch(poses, even, poses[:, 0], torch.zeros(runs))


def first_share(belief: BeliefBatch) -> Tensor:
    """Return the share of each run's particles at the first mode.  -> (RUNS,)."""
    return (angle_between(rotation_of(belief.poses), torch.eye(3).double()) < 1).double().mean(1)


def spread(belief: BeliefBatch) -> Tensor:
    """Return the standard deviation of shifts and turns from the nearer mode.  -> (6,)."""
    near = angle_between(rotation_of(belief.poses), torch.eye(3).double()) < 1
    turn = torch.where(near[..., None, None], torch.eye(3).double(), HALF)
    mode = make_pose(turn, CENTER - turn @ CENTER)
    return twist_between(mode, belief.poses, CENTER).square().mean((0, 1)).sqrt()


def move(belief: BeliefBatch, mass: float, **options: float) -> BeliefBatch:
    g = torch.Generator().manual_seed(1)
    return ResampleMove(**options)(belief, None, TwoModes(mass), g)  # type: ignore[arg-type]


@pytest.mark.parametrize("turns", [0.0, 0.5, 1.0])
def test_draws_of_the_posterior_stay_draws_of_it(turns: float) -> None:
    """Both kinds of steps, alone and together; 12,000 particles."""
    before = draw(0.7)
    after = move(before, 0.7, sweeps=6, rotation_probability=turns)
    error = math.sqrt(0.7 * 0.3 / (RUNS * COUNT))
    assert float(first_share(after).mean()) == pytest.approx(0.7, abs=5 * error)
    wanted = torch.tensor([SHIFT] * 3 + [TURN] * 3).double()
    assert bool(((spread(after) / wanted - 1).abs() < 0.04).all())
    # and they are others: resampling alone would leave them in place
    moved = (after.poses - before.poses).abs().amax((2, 3)) > 1e-6
    assert float(moved.double().mean()) > 0.5


def test_masses_of_equal_modes_are_right_within_sampling_error() -> None:
    """From 7 : 3, over 200 runs: the mean, and the spread between runs, are those of draws."""
    share = first_share(move(draw(0.7), 0.5, sweeps=30, rotation_probability=0.5))
    error = math.sqrt(0.25 / COUNT)
    assert float(share.mean()) == pytest.approx(0.5, abs=5 * error / math.sqrt(RUNS))
    assert float(share.std()) == pytest.approx(error, rel=0.35)


def test_a_lost_mode_is_found_by_turns_and_not_without() -> None:
    lost = draw(1.0, runs=20)
    found = first_share(move(lost, 0.5, sweeps=15, rotation_probability=0.3))
    assert float((found < 1).double().mean()) == 1
    without = first_share(move(lost, 0.5, sweeps=15, rotation_probability=0.0))
    assert float(without.min()) == 1


def test_particles_that_are_too_narrow_spread_to_the_posterior() -> None:
    narrow = draw(0.5, width=0.3, runs=40)
    wanted = torch.tensor([SHIFT] * 3 + [TURN] * 3).double()
    assert bool((spread(narrow) / wanted < 0.35).all())
    after = spread(move(narrow, 0.5, sweeps=40)) / wanted
    assert bool(((after - 1).abs() < 0.1).all())


def test_a_step_of_differences_is_as_likely_as_its_inverse() -> None:
    """The mean of an odd function of the steps is 0, as it is not for pairs in one order."""
    g = torch.Generator().manual_seed(2)
    poses = draw(0.7).poses[:1]
    steps = draw_differences(poses, 40_000, TwoModes.space, g)[0]
    sign = steps[:, :3].sign().mean(0)
    assert bool((sign.abs() < 5 / math.sqrt(40_000)).all())
    # every step is one between two of the particles
    start = poses[0].repeat_interleave(COUNT, 0)
    pairs = twist_between(start, poses[0].repeat(COUNT, 1, 1), CENTER)
    assert float((steps[:50, None] - pairs).norm(dim=-1).min(1).values.max()) < 1e-9


def test_the_estimate_is_kept_and_the_seed_decides() -> None:
    before = draw(0.7)
    one, other = move(before, 0.7, sweeps=2), move(before, 0.7, sweeps=2)
    assert torch.equal(one.poses, other.poses)
    assert torch.equal(one.best, before.best)
    assert float((one.log_weights + math.log(COUNT)).abs().max()) < 1e-12


def test_a_single_particle_turns_alone() -> None:
    one = BeliefBatch(*(x[:, :1] if x.dim() > 1 and x.shape[1] == COUNT else x for x in draw(1.0)))
    one = one._replace(log_weights=torch.zeros(RUNS, 1).double())
    after = move(one, 0.5, sweeps=5)
    assert after.poses.shape == (RUNS, 1, 4, 4)
    assert 0.02 < float((first_share(after) < 1).double().mean()) < 0.7


def test_steps_of_a_turn_are_about_the_axes() -> None:
    """With turns alone, a particle's rotation is a product of turns about x, y or z; one sweep."""
    after = move(draw(1.0, width=0.0), 0.5, sweeps=1, rotation_probability=1.0)
    vector = twist_between(torch.eye(4).double(), after.poses, CENTER)[..., 3:]
    assert torch.allclose(exp_so3(vector), rotation_of(after.poses), atol=1e-6)
    assert int(((vector.abs() > 1e-6).sum(-1) > 1).sum()) == 0


@pytest.mark.parametrize(
    "wrong", [{"sweeps": -1}, {"rotation_probability": 1.5}, {"temperature": 0.0}]
)
def test_numbers_out_of_range_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(UserError, match="resample-move needs"):
        ResampleMove(**wrong)  # type: ignore[arg-type]


def test_without_a_sweep_particles_are_resampled_by_their_weights() -> None:
    """Systematically: of a weight w there are floor(N w) or ceil(N w), and N w on average."""
    before = draw(0.7)
    g = torch.Generator().manual_seed(5)
    log_w = torch.randn(1, COUNT, generator=g).double().log_softmax(1).expand(RUNS, -1)
    after = move(before._replace(log_weights=log_w), 0.7, sweeps=0)
    same = after.poses[:, :, None, 0, 3] == before.poses[:, None, :, 0, 3]
    counts, wanted = same.double().sum(1), COUNT * log_w.exp()
    assert bool(((counts - wanted).abs() < 1).all())
    torch.testing.assert_close(counts.mean(0), wanted[0], atol=5 * 0.5 / math.sqrt(RUNS), rtol=0)


@pytest.mark.parametrize("far", [False, True])
def test_near_and_far_pairs_are_as_likely_in_either_order(far: bool) -> None:
    places = torch.arange(30).double() ** 2 / 100  # ascending, so that an order is a direction
    poses = make_pose(torch.eye(3).double().expand(30, 3, 3), torch.nn.functional.pad(
        places[:, None], (0, 2)
    ))[None]  # fmt: skip
    g = torch.Generator().manual_seed(3)
    steps = draw_differences(poses, 40_000, TwoModes.space, g)[0, :, 0]
    middle = steps.abs().median()
    own = steps[(steps.abs() > middle) == far]
    assert abs(float(own.sign().mean())) < 5 / math.sqrt(len(own))
