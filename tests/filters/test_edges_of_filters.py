"""What filters make of what lies at an edge: nearest leaders, empty islands, single moves."""

import math
from typing import Any

import pytest
import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.filters.auxiliary import AuxiliaryResampling
from posefilter.filters.estimate import Mean
from posefilter.filters.loop import make_particles
from posefilter.filters.modes import find_modes, find_pose_modes
from posefilter.filters.refine import Gradient, MeanShift, Rescore
from posefilter.filters.resample import AdaptiveResampling, Islands, Soft, Systematic
from posefilter.filters.resample_move import ResampleMove, draw_differences
from posefilter.filters.reweight import CurrentLikelihood, LikelihoodRatio, SequentialBayes
from posefilter.geometry.pose import make_pose
from posefilter.geometry.spaces import PixelSpace, PoseSpace
from posefilter.types import BeliefBatch, ParticleOutput

PIXELS = PixelSpace()
POSES = PoseSpace((0.0, 0.0, 0.0), 0.1)


def shifted(shifts: list[float], dtype: torch.dtype = torch.float64) -> Tensor:
    t = torch.tensor([[x, 0.0, 0.0] for x in shifts], dtype=dtype)
    return make_pose(torch.eye(3, dtype=dtype).expand(len(shifts), 3, 3), t)


@pytest.mark.parametrize(("gap", "modes"), [(0.0199, 1), (0.0201, 2), (0.03, 2), (0.06, 2)])
def test_poses_nearer_than_a_tenth_of_the_diameter_are_one_mode(gap: float, modes: int) -> None:
    found = find_pose_modes(shifted([0.0, gap]), torch.tensor([0.6, 0.4]).log(), POSES, 0.2)
    assert len(found.weights) == modes


def test_the_density_that_decides_who_follows_whom_is_over_a_thirtieth_of_the_diameter() -> None:
    """Kernels of 0.2 / 30 = 6.7 mm: two light poses 1 mm apart are denser than a heavier one
    18 mm away, and the mode is one of them; under wide kernels it would be the heavier one.
    """
    poses = shifted([0.0, 0.001, 0.0185])
    found = find_pose_modes(poses, torch.tensor([0.3, 0.31, 0.39]).log(), POSES, 0.2)
    assert len(found.weights) == 1
    assert float(found.states[0, 0, 3]) == pytest.approx(0.001)


def test_a_particle_follows_the_nearest_that_is_denser_at_the_reach_too() -> None:
    """0 is densest, 10 next; 7 lies nearer to 10, and 3 at its reach from 0."""
    state = torch.tensor([[0.0, 0.0], [10.0, 0.0], [7.0, 0.0], [-3.0, 0.0]])
    found = find_modes(
        state, torch.tensor([0.5, 0.3, 0.1, 0.1]).log(), PIXELS, 1.0, max_distance=3.0
    )
    assert found.member.tolist() == [0, 1, 1, 0]
    assert found.weights.tolist() == pytest.approx([0.6, 0.4])


def test_an_island_without_weight_has_children_without_weight_and_no_others_suffer() -> None:
    log_w = torch.tensor([[0.5, 0.5, 0.0, 0.0, 0.0, 0.0]]).log()
    particles = make_particles(torch.arange(12.0).view(1, 6, 2), 0)._replace(log_weights=log_w)
    new = Islands(Systematic(), 2)(particles, 6, PIXELS, Generator().manual_seed(0))
    assert new.log_weights.exp().tolist() == [[0.5, 0.5, 0, 0, 0, 0]]
    assert sorted(new.ancestors[0].tolist()) == [0, 1, 2, 3, 4, 5]
    assert not new.log_weights.isnan().any()
    # those of an empty island are drawn evenly among it, of any number
    more = Islands(Systematic(), 2)(particles, 12, PIXELS, Generator().manual_seed(0))
    assert sorted(more.ancestors[0].tolist()) == sorted(2 * list(range(6)))


@pytest.mark.parametrize(
    ("count", "children", "size", "islands"),
    [
        (12, 12, 3, 4),
        (12, 12, 5, 2),
        (12, 8, 2, 4),
        (12, 12, 13, 1),
        (12, 12, 12, 1),
        (4, 4, 1, 4),
        (12, 24, 6, 2),
        (12, 4, 2, 2),
    ],
)
def test_islands_have_their_size_at_least_and_divide_all(
    count: int, children: int, size: int, islands: int
) -> None:
    """All weight is with the first particle: its island's children are its copies."""
    log_w = torch.full((1, count), -torch.inf)
    log_w[0, 0] = 0.0
    particles = make_particles(torch.zeros(1, count, 2), 0)._replace(log_weights=log_w)
    new = Islands(Systematic(), size)(particles, children, PIXELS, Generator().manual_seed(0))
    assert int((new.ancestors == 0).sum()) == children // islands
    assert float(new.log_weights.exp().sum()) == pytest.approx(1)


def test_resampling_begins_below_the_threshold() -> None:
    """Two of four equal weights: an effective size of 2, which is not below 0.5 x 4."""
    log_w = torch.tensor([[0.5, 0.5, 0.0, 0.0]]).log()
    particles = make_particles(torch.zeros(1, 4, 2), 0)._replace(log_weights=log_w)
    for threshold, resampled in ((0.49, False), (0.51, True)):
        new = AdaptiveResampling(Systematic(), threshold)(
            particles, 4, PIXELS, Generator().manual_seed(0)
        )
        assert (new.ancestors.tolist() != [[0, 1, 2, 3]]) == resampled


def test_soft_weights_are_by_hand() -> None:
    """Half of q is the weights and half even: a particle of weight 0.7 of two has q = 0.6."""
    log_w = torch.tensor([[0.7, 0.3]]).log()
    particles = make_particles(torch.zeros(1, 2, 2), 0)._replace(log_weights=log_w)
    new = Soft(0.5)(particles, 10, PIXELS, Generator().manual_seed(0))
    assert int((new.ancestors == 0).sum()) == 6
    ratio = float((new.log_weights[0, 0] - new.log_weights[0, -1]).exp())
    assert ratio == pytest.approx((0.7 / 0.6) / (0.3 / 0.4))
    for alpha in (0.0, 1.0):
        assert Soft(alpha).alpha == alpha


def test_soft_resampling_of_particles_without_weight_has_equal_weights() -> None:
    log_w = torch.full((1, 100), -torch.inf)
    log_w[0, 10] = 0.0
    particles = make_particles(torch.zeros(1, 100, 2), 0)._replace(log_weights=log_w)
    for seed in range(5):
        new = Soft(0.0)(particles, 2, PIXELS, Generator().manual_seed(seed))
        assert not (new.ancestors == 10).any()
        assert new.log_weights.exp().tolist() == [[0.5, 0.5]]


class Hill:
    """Scores a pose by how far along x it is; what it was asked is kept."""

    space = POSES

    def __init__(self, slope: float = 1.0) -> None:
        self.slope = slope
        self.counts: list[int] = []
        self.seeds: list[int] = []

    def score_poses(
        self, encoding: Any, poses: Tensor, sigma: float, generator: Generator, pixels: int
    ) -> Tensor:
        self.counts.append(poses.shape[1])
        self.seeds.append(generator.initial_seed())
        return self.slope * 100 * poses[..., 0, 3]


def belief(count: int) -> BeliefBatch:
    poses = shifted([0.001 * k for k in range(count)])[None]
    even = torch.full((1, count), -math.log(count)).double()
    return BeliefBatch(poses, even, poses[:, 0], torch.zeros(1).double())


def move(method: Hill, seed: int, **settings: float) -> BeliefBatch:
    moves = ResampleMove(sweeps=3, **settings)  # type: ignore[arg-type]
    return moves(belief(10), None, method, Generator().manual_seed(seed))  # type: ignore[arg-type]


def test_a_sweep_moves_one_half_after_the_other_and_looks_at_the_same_points() -> None:
    one, other, third = Hill(), Hill(), Hill()
    for method, seed in ((one, 1), (other, 1), (third, 2)):
        move(method, seed)
    assert one.counts == [10] + 3 * [5, 5]
    assert len(set(one.seeds)) == 1
    assert one.seeds == other.seeds
    assert one.seeds != third.seeds


def test_a_temperature_divides_the_log_likelihood() -> None:
    """Twice the slope at twice the temperature is the same target: bit by bit the same moves."""
    plain, hot = move(Hill(), 1), move(Hill(4.0), 1, temperature=4.0)
    assert torch.equal(plain.poses, hot.poses)
    assert not torch.equal(plain.poses, move(Hill(4.0), 1).poses)


def test_with_few_partners_there_is_no_difference() -> None:
    none = draw_differences(shifted([0.1])[None], 4, POSES, Generator())
    assert torch.equal(none, torch.zeros(1, 4, 6).double())
    pair = draw_differences(shifted([0.0, 0.1])[None], 50, POSES, Generator().manual_seed(0))
    assert sorted({round(x, 6) for x in pair[0, :, 0].tolist()}) == [-0.1, 0.1]


def test_one_shift_of_one_pair_goes_up() -> None:
    """The mean of a pair by their weights is never on the lower side."""
    method = Hill()
    shift = MeanShift(iterations=1, antithetic_pairs=1, initial_scale=0.01, final_scale=0.01)
    found = shift(belief(4), None, method, Generator().manual_seed(0))  # type: ignore[arg-type]
    assert method.counts == [2, 1]
    assert float(found.best[0, 0, 3]) > 0
    assert float(found.score) == pytest.approx(100 * float(found.best[0, 0, 3]))


def test_shifts_narrow_from_the_start_to_the_end_by_equal_ratios() -> None:
    """On even ground the spread of what is scored is that of the iteration."""

    class Flat(Hill):
        spreads: list[float]

        def score_poses(
            self, encoding: Any, poses: Tensor, sigma: float, generator: Generator, pixels: int
        ) -> Tensor:
            if poses.shape[1] > 1:
                self.spreads.append(float(poses[..., :3, 3].std()))
            return torch.zeros(poses.shape[:2])

    method = Flat()
    method.spreads = []
    shift = MeanShift(iterations=3, antithetic_pairs=4000, initial_scale=0.016, final_scale=0.004)
    shift(belief(2), None, method, Generator().manual_seed(0))  # type: ignore[arg-type]
    assert method.spreads == pytest.approx([0.016, 0.008, 0.004], rel=0.05)


def test_the_first_steps_of_a_climb_have_its_length_and_the_last_are_shorter() -> None:
    """Adam's steps on a slope have the length of the rate, which falls linearly: n steps of rate r
    go (n + 1) / 2 r.
    """

    class Score(Hill):
        def score_poses(
            self, encoding: Any, poses: Tensor, sigma: float, generator: Generator, pixels: int
        ) -> Tensor:
            return 1000 * super().score_poses(encoding, poses, sigma, generator, pixels)

    climb = Gradient(steps=9, lr=1e-3)
    one = belief(4)
    start = one._replace(poses=one.poses.float(), best=one.best.float())
    found = climb(start, None, Score(), Generator())  # type: ignore[arg-type]
    assert float(found.best[0, 0, 3]) == pytest.approx(5e-3, rel=1e-3)


def test_the_estimate_and_the_heaviest_are_scored_again_all_there_are_at_most() -> None:
    method = Hill()
    few = Rescore(top_k=2)(belief(4), None, method, Generator())  # type: ignore[arg-type]
    all_of_them = Rescore(top_k=9)(belief(4), None, method, Generator())  # type: ignore[arg-type]
    assert method.counts == [3, 5]
    assert float(few.best[0, 0, 3]) <= float(all_of_them.best[0, 0, 3]) == pytest.approx(0.003)


def test_modes_reach_three_bandwidths() -> None:
    state = torch.tensor([[0.0, 0.0], [2.9, 0.0], [10.0, 0.0], [13.1, 0.0]])
    found = find_modes(state, torch.tensor([0.4, 0.1, 0.3, 0.2]).log(), PIXELS, 1.0)
    assert found.member.tolist() == [0, 0, 1, 2]


def test_near_pairs_are_preferred_as_the_logarithm_says() -> None:
    """A share s, log-uniform from 1 / 200 to 1, then an even draw of the share s of the nearest.

    The nearest hundredth q is drawn with probability P(s < q) + q E[1 / s; s > q], which is
    (ln 2 + 1 - q) / ln 200 = 0.32.
    """
    g = Generator().manual_seed(5)
    places = torch.rand(60, generator=g).double()
    steps = draw_differences(shifted(places.tolist())[None], 20_000, POSES, g)[0, :, 0].abs()
    apart = (places[:, None] - places).abs()[tuple(torch.triu_indices(60, 60, 1))].sort().values
    share = len(apart) // 100 / len(apart)
    want = (math.log(200 * share) + 1 - share) / math.log(200)
    found = (steps < (apart[len(apart) // 100 - 1] + apart[len(apart) // 100]) / 2).double().mean()
    assert float(found) == pytest.approx(want, abs=0.02)
    assert float(steps.max()) > 0.8 * float(apart.max())


def test_only_some_hundreds_of_partners_are_compared() -> None:
    """Those that come first, here a meter apart; the others, each near to one of them, are none."""
    poses = shifted([*map(float, range(300)), *(k + 0.001 for k in range(300))])[None]
    steps = draw_differences(poses, 2000, POSES, Generator().manual_seed(0))
    assert float(steps[..., 0].abs().min()) == pytest.approx(1)


def test_an_auxiliary_draw_by_hand() -> None:
    """Objectnesss of 1 and 0.01, of which the floor makes 0.25: with even weights four of five
    children are of the first, each with a quarter of the weight that one of the second has.
    """
    particles = make_particles(torch.tensor([[[0.0, 0.0], [1.0, 0.0]]]), 0)
    encoding = Objectness(torch.tensor([1.0, 0.01]).view(1, 1, 1, 2))
    draw = AuxiliaryResampling(Systematic(), floor=0.25).bind(encoding, 1, 2)
    new = draw(particles, 10, PIXELS, Generator().manual_seed(0))
    assert int((new.ancestors == 0).sum()) == 8
    first, last = new.log_weights[0, [0, -1]].exp().tolist()
    assert last / first == pytest.approx(4)
    assert float(new.log_weights.exp().sum()) == pytest.approx(1)
    assert AuxiliaryResampling(Systematic(), floor=1.0).floor == 1
    for floor in (0.0, 1.1, math.nan):
        with pytest.raises(UserError, match="floor="):
            AuxiliaryResampling(Systematic(), floor=floor)


class Objectness:
    def __init__(self, objectness: Tensor) -> None:
        self.objectness = objectness


def test_a_mean_has_a_score_though_some_likelihood_is_zero() -> None:
    poses = shifted([0.0, 0.1, 5.0])[None]
    particles = make_particles(poses, 0)._replace(
        log_weights=torch.tensor([[0.5, 0.5, 0.0]]).double().log()
    )
    log_p = torch.tensor([[-1.0, -3.0, -math.inf]]).double()
    output = ParticleOutput(log_p, torch.zeros(1, 3, 6), poses, particles.latent)
    found = Mean()(particles, output, None, Hill(), Generator())  # type: ignore[arg-type]
    assert float(found.score) == pytest.approx(-2)
    assert float(found.best[0, 0, 3]) == pytest.approx(0.05)


def test_weights_of_three_kinds_by_hand() -> None:
    before, now, then = (torch.tensor([x]) for x in ([-1.0, -2.0], [0.5, 0.25], [0.125, 1.0]))
    assert SequentialBayes()(before, now, then).tolist() == [[-0.5, -1.75]]
    assert LikelihoodRatio()(before, now, then).tolist() == [[-0.625, -2.75]]
    assert CurrentLikelihood()(before, now, then)[0].tolist() == pytest.approx(
        [0.5 - math.log(2), 0.25 - math.log(2)]
    )


def test_what_was_impossible_stays_so_by_the_ratio() -> None:
    none, some = -math.inf, torch.tensor([[0.5, 0.25]])
    then = torch.tensor([[none, 1.0]])
    for before in ([[none, 0.0]], [[-1.0, 0.0]]):  # kept, and drawn anew by a soft resampling
        weights = LikelihoodRatio()(torch.tensor(before), some, then)
        assert weights.tolist() == [[none, -0.75]]
