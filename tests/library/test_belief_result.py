"""The moments and modes of a belief are those of the distribution that it was drawn from."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from posefilter import Belief, UserError
from posefilter.geometry.pose import make_pose, move_about
from posefilter.geometry.pose_statistics import covariance_about, twist_between
from posefilter.geometry.rotation import angle_between, exp_so3

CENTER = np.array([0.02, -0.01, 0.1])
RADIUS, DIAMETER = 0.15, 0.28


def some_pose(seed: int = 0) -> torch.Tensor:
    turn = torch.randn(3, generator=torch.Generator().manual_seed(seed)).double()
    return make_pose(exp_so3(turn), torch.tensor([0.1, -0.2, 1.0]).double())


def spread_about(pose: torch.Tensor, covariance: np.ndarray, count: int) -> np.ndarray:
    """Draw poses whose twists about a pose are Gaussian."""
    twists = np.random.default_rng(1).multivariate_normal(np.zeros(6), covariance, count)
    return move_about(pose, torch.from_numpy(twists), torch.from_numpy(CENTER)).numpy()


def belief_of(samples: np.ndarray, weights: np.ndarray | None = None) -> Belief:
    weights = np.ones(len(samples)) if weights is None else weights
    return Belief(samples, weights / weights.sum(), CENTER, RADIUS, DIAMETER, "thing")


def known_covariance() -> np.ndarray:
    """A covariance with correlations, of millimeters and degrees."""
    scale = np.diag([0.004, 0.002, 0.008, 0.02, 0.05, 0.03])
    mix = np.eye(6)
    mix[0, 4] = mix[4, 0] = 0.6
    mix[1, 2] = mix[2, 1] = -0.5
    return scale @ mix @ scale


def test_a_twist_undoes_a_move_and_a_zero_twist_is_no_move() -> None:
    generator = torch.Generator().manual_seed(2)
    twist = 2 * torch.rand(50, 6, generator=generator).double() - 1  # turns below pi
    center, pose = torch.from_numpy(CENTER), some_pose()
    assert torch.allclose(
        twist_between(pose, move_about(pose, twist, center), center), twist, atol=1e-9
    )
    assert torch.allclose(twist_between(pose, pose, center), torch.zeros(6).double(), atol=1e-12)


def test_a_gaussian_has_its_covariance_in_its_own_order_and_frames() -> None:
    truth = known_covariance()
    belief = belief_of(spread_about(some_pose(), truth, 40_000))
    scale = np.sqrt(np.outer(np.diag(truth), np.diag(truth)))
    assert np.abs((belief.covariance - truth) / scale).max() < 0.03
    assert np.allclose(belief.mean, some_pose().numpy(), atol=1e-3)
    assert np.allclose(belief.covariance, belief.covariance.T)
    assert np.linalg.eigvalsh(belief.covariance).min() > 0


def test_one_shift_and_one_turn_stand_where_the_documentation_says() -> None:
    """Two particles 2 cm apart along the camera's y; then two turned about the object's z."""
    apart = np.repeat(some_pose().numpy()[None], 2, 0)
    apart[1, 1, 3] += 0.02
    expected = np.zeros((6, 6))
    expected[1, 1] = 0.01**2
    assert np.allclose(belief_of(apart).covariance, expected, atol=1e-12)
    turned = move_about(
        some_pose().expand(2, 4, 4),
        torch.tensor([[0, 0, 0, 0, 0, 0.1], [0, 0, 0, 0, 0, -0.1]]).double(),
        torch.from_numpy(CENTER),
    ).numpy()
    expected = np.zeros((6, 6))
    expected[5, 5] = 0.1**2
    assert np.allclose(belief_of(turned).covariance, expected, atol=1e-12)


def test_covariance_turns_with_the_camera_and_not_with_the_object() -> None:
    """A camera turned by Q turns the shifts alone: turns are in the object's own axes."""
    samples = spread_about(some_pose(), known_covariance(), 500)
    Q = exp_so3(torch.tensor([0.3, -0.5, 0.9]).double())
    turned = (make_pose(Q, torch.zeros(3).double()) @ torch.from_numpy(samples)).numpy()
    both = torch.block_diag(Q, torch.eye(3).double()).numpy()
    expected = both @ belief_of(samples).covariance @ both.T
    assert np.allclose(belief_of(turned).covariance, expected, atol=1e-12)


def test_order_of_particles_and_splitting_one_change_nothing() -> None:
    samples = spread_about(some_pose(), known_covariance(), 300)
    weights = np.random.default_rng(3).random(300)
    belief, order = belief_of(samples, weights), np.random.default_rng(4).permutation(300)
    shuffled = belief_of(samples[order], weights[order])
    split = belief_of(
        np.concatenate([samples, samples[:1]]),
        np.concatenate([[weights[0] / 2], weights[1:], [weights[0] / 2]]),
    )
    for other in (shuffled, split):
        assert np.allclose(other.mean, belief.mean)
        assert np.allclose(other.covariance, belief.covariance)
        assert [m.mass for m in other.modes] == pytest.approx([m.mass for m in belief.modes])
    assert shuffled.weight_entropy == pytest.approx(belief.weight_entropy)
    assert shuffled.effective_samples == pytest.approx(belief.effective_samples)


def test_two_clusters_are_two_modes_with_their_masses_and_their_own_spread() -> None:
    upside_down = some_pose() @ make_pose(
        exp_so3(torch.tensor([np.pi, 0, 0]).double()), torch.zeros(3).double()
    )
    truth = known_covariance() / 4
    samples = np.concatenate(
        [spread_about(some_pose(), truth, 600), spread_about(upside_down, truth, 200)]
    )
    weights = np.concatenate([np.full(600, 0.3 / 600), np.full(200, 0.7 / 200)])
    modes = belief_of(samples, weights).modes
    first, second = modes[:2]
    assert (first.mass, second.mass) == pytest.approx((0.7, 0.3), abs=0.02)
    assert sum(mode.mass for mode in modes) == pytest.approx(1)
    assert angle_between(torch.from_numpy(first.pose[:3, :3]), upside_down[:3, :3]) < np.deg2rad(5)
    scale = np.sqrt(np.outer(np.diag(truth), np.diag(truth)))
    assert np.abs((first.covariance - truth) / scale).max() < 0.35
    assert np.sqrt(belief_of(samples, weights).covariance[3:, 3:].trace()) > 1  # of both together


def test_weight_that_shifts_moves_the_mean() -> None:
    poses = np.repeat(some_pose().numpy()[None], 2, 0)
    poses[1, 0, 3] += 0.1
    for share in (0.0, 0.25, 1.0):
        belief = belief_of(poses, np.array([1 - share, share]))
        assert belief.mean[0, 3] - poses[0, 0, 3] == pytest.approx(0.1 * share)
        assert belief.covariance[0, 0] == pytest.approx(share * (1 - share) * 0.01)


def test_entropy_and_effective_samples_know_their_ends() -> None:
    poses = np.repeat(some_pose().numpy()[None], 8, 0)
    alike, sure = belief_of(poses), belief_of(poses, np.eye(8)[0])
    assert (alike.weight_entropy, alike.effective_samples) == pytest.approx((np.log(8), 8))
    assert (sure.weight_entropy, sure.effective_samples) == pytest.approx((0, 1))


def test_the_density_knows_how_far_particles_are_and_the_weights_do_not() -> None:
    near, far = (
        belief_of(spread_about(some_pose(), size * known_covariance(), 200)) for size in (0.01, 1)
    )
    assert near.weight_entropy == far.weight_entropy == near.entropy
    # a tenth of the width in each of six axes
    gap = far.differential_entropy - near.differential_entropy
    assert gap == pytest.approx(6 * np.log(10), abs=1)


def test_covariance_about_another_pose_holds_its_offset() -> None:
    samples = torch.from_numpy(spread_about(some_pose(), known_covariance(), 50))
    weights, center = torch.full((50,), 1 / 50).double(), torch.from_numpy(CENTER)
    aside = some_pose()
    aside[0, 3] -= 1.0
    spread = covariance_about(some_pose(), samples, weights, center)
    assert covariance_about(aside, samples, weights, center)[0, 0] > 0.9
    assert spread[0, 0] < 1e-3


def test_what_is_saved_is_read_back(tmp_path: Path) -> None:
    weights = np.random.default_rng(5).random(40)
    belief = belief_of(spread_about(some_pose(), known_covariance(), 40), weights)
    belief.save(tmp_path / "belief.npz")
    again = Belief.load(tmp_path / "belief.npz")
    assert (again.object, again.radius, again.diameter) == ("thing", RADIUS, DIAMETER)
    assert np.allclose(again.samples, belief.samples, atol=1e-6)
    assert np.allclose(again.weights, belief.weights, atol=1e-7)
    assert np.allclose(again.covariance, belief.covariance, atol=1e-7)


def test_what_is_no_belief_is_refused_in_one_line(tmp_path: Path) -> None:
    good = np.repeat(some_pose().numpy()[None], 3, 0)
    (tmp_path / "text.npz").write_text("no archive")
    np.savez(tmp_path / "other.npz", poses=good)
    np.savez(tmp_path / "pickle.npz", poses=np.array([object()], dtype=object), weights=np.ones(1))
    for name in ("none", "text", "other", "pickle"):
        with pytest.raises(UserError, match=name) as caught:
            Belief.load(tmp_path / f"{name}.npz")
        assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="rigid"):
        belief_of(2 * good)
    with pytest.raises(UserError, match="sum to 1"):
        Belief(good, np.ones(3), CENTER, RADIUS, DIAMETER)
    with pytest.raises(UserError, match=r"\(N, 4, 4\)"):
        Belief(good, np.ones(2) / 2, CENTER, RADIUS, DIAMETER)
    for weights in (1.0, None):
        with pytest.raises(UserError, match=r"\(N, 4, 4\)"):
            Belief(good, weights, CENTER, RADIUS, DIAMETER)  # type: ignore[arg-type]
    learned = torch.from_numpy(good).requires_grad_()
    with pytest.raises(UserError, match="samples should be numbers"):
        Belief(learned, np.ones(3) / 3, CENTER, RADIUS, DIAMETER)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="first 2 samples are draws, and have no weight"):
        Belief(good, np.array([0.0, 0.0, 1.0]), CENTER, RADIUS, DIAMETER, draws=2)


def test_a_particle_without_weight_is_no_mode() -> None:
    """As a saved belief has it: weights below the smallest of single precision are 0."""
    far = some_pose().clone()
    far[0, 3] += 1
    samples = np.concatenate([spread_about(some_pose(), known_covariance(), 50), far[None].numpy()])
    belief = belief_of(samples, np.append(np.ones(50), 0.0))
    assert sum(mode.mass for mode in belief.modes) == pytest.approx(1)
    assert all(mode.mass > 0 for mode in belief.modes)
    assert np.isfinite(belief.covariance).all()


def test_a_belief_of_single_precision_is_one_of_double() -> None:
    """A filter of one's own has float32, whose weights sum to 1 but for rounding."""
    samples = spread_about(some_pose(), known_covariance(), 60)
    weights = np.random.default_rng(6).random(60)
    weights /= weights.sum()
    double = Belief(samples, weights, CENTER, RADIUS, DIAMETER)
    rounded = (1.0005 * weights).astype(np.float32)
    single = Belief(samples.astype(np.float32), rounded, CENTER.astype(np.float32), 0.15, 0.28)
    assert single.samples.dtype == single.weights.dtype == single.center.dtype == np.float64
    assert single.weights.sum() == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(single.covariance, double.covariance, rtol=1e-3, atol=1e-9)
    assert single.differential_entropy == pytest.approx(double.differential_entropy, abs=0.01)
    # a weight above 1 would have no density without its own kernel
    alone = Belief(samples[:2], np.array([1.0005, 0.0]), CENTER, RADIUS, DIAMETER)
    assert alone.weights.tolist() == [1, 0]
    assert np.isfinite(alone.differential_entropy)
    lists = Belief(samples.tolist(), weights.tolist(), CENTER.tolist(), RADIUS, DIAMETER)  # type: ignore[arg-type]
    assert np.array_equal(lists.weights, weights)  # which need no more than that


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"center": np.zeros(2)}, "the center should be three numbers"),
        ({"center": np.array([0.0, np.nan, 0.0])}, "the center should be three numbers"),
        ({"radius": 0.0}, "the radius should be above 0, and is 0.0"),
        ({"diameter": np.nan}, "the diameter should be above 0, and is nan"),
        ({"diameter": None}, "the diameter should be above 0, and is nan"),
        ({"radius": "0.1 m"}, "the radius should be numbers"),
        ({"draws": 0.5}, "0.5 of its 1 samples cannot be draws"),
        ({"samples": [["a"]]}, "samples should be numbers in an array"),
    ],
)
def test_a_belief_without_a_place_or_a_size_is_refused(changed: dict[str, Any], said: str) -> None:
    good = {
        "samples": np.eye(4)[None],
        "weights": np.ones(1),
        "center": CENTER,
        "radius": RADIUS,
        "diameter": DIAMETER,
    }
    with pytest.raises(UserError, match=f"^belief: {said}"):
        Belief(**good | changed)  # type: ignore[arg-type]
