"""Sets of poses, marginals, words and projections of a belief say what the particles say."""

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from posefilter import Belief, UserError
from posefilter.geometry.pose import make_pose, move_about
from posefilter.geometry.rotation import exp_so3
from posefilter.meshes.symmetries import symmetry_group

CENTER = np.array([0.02, -0.01, 0.1])
RADIUS, DIAMETER = 0.15, 0.28
SCALE = np.array([0.004, 0.002, 0.008, 0.02, 0.05, 0.03])
K = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])


def middle() -> torch.Tensor:
    turn = torch.tensor([0.4, -0.8, 0.3]).double()
    return make_pose(exp_so3(turn), torch.tensor([0.1, -0.2, 1.0]).double())


def draw(count: int, seed: int, scale: np.ndarray = SCALE) -> np.ndarray:
    noise = torch.from_numpy(np.random.default_rng(seed).normal(size=(count, 6)) * scale)
    return move_about(middle().expand(count, 4, 4), noise, torch.from_numpy(CENTER)).numpy()


def belief_of(samples: np.ndarray, weights: np.ndarray | None = None, **more: object) -> Belief:
    weights = np.ones(len(samples)) if weights is None else weights
    return Belief(samples, weights / weights.sum(), CENTER, RADIUS, DIAMETER, "thing", **more)  # type: ignore[arg-type]


def half_turn() -> np.ndarray:
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    turn[:3, 3] = CENTER - turn[:3, :3] @ CENTER
    return np.stack([np.eye(4), turn])


def test_credible_sets_hold_their_share_of_what_the_belief_was_drawn_from() -> None:
    """Particles are drawn broadly and weighted to be the belief: the weights must count."""
    broad = draw(500, 0, 1.5 * SCALE)
    noise = np.random.default_rng(0).normal(size=(500, 6)) * 1.5 * SCALE
    belief = belief_of(broad, np.exp(-0.5 * (noise**2 / SCALE**2 * (1 - 1 / 1.5**2)).sum(1)))
    fresh, last = draw(500, 1), np.zeros(500, bool)
    for level in (0.5, 0.8, 0.95):
        inside = belief.contains(fresh, level)
        assert inside.mean() == pytest.approx(level, abs=0.08)
        assert (inside | ~last).all()  # a set of a higher level holds those of lower ones
        last = inside
        one = belief.credible_set(level)
        assert one.weights.sum() == pytest.approx(level, abs=0.03)
        assert one.contains(fresh).tolist() == inside.tolist()
        assert one.coverage == one.level == level
        assert one.min_log_density == one.least
        again = belief.highest_density_region(one.coverage, one.min_log_density)
        for wrong in ((90, 3.0), (0.9, "3"), (0.9, float("nan"))):
            with pytest.raises(UserError, match=r"coverage is between|threshold .* is no number"):
                belief.highest_density_region(*wrong)
        assert np.array_equal(again.samples, one.samples)
    assert not belief.credible_set(0.999).contains(move_far(middle().numpy()))
    assert belief.credible_set(1.0).weights.sum() == pytest.approx(1)
    with pytest.raises(UserError, match=r"1\.5"):
        belief.credible_set(1.5)


def move_far(pose: np.ndarray) -> np.ndarray:
    pose = pose.copy()
    pose[2, 3] += 0.3
    return pose


def test_a_wider_belief_has_a_higher_entropy_by_the_logarithm_of_its_volume() -> None:
    narrow, wide = (belief_of(draw(400, 2, factor * SCALE)) for factor in (1.0, 2.0))
    assert wide.differential_entropy - narrow.differential_entropy == pytest.approx(
        6 * math.log(2), abs=0.25
    )
    # of a Gaussian, in rotation vectors, less the logarithm of 8 for the unit of rotation
    exact = 3 * math.log(2 * math.pi * math.e) + np.log(SCALE).sum() - math.log(8)
    assert narrow.differential_entropy == pytest.approx(exact, abs=0.6)


def test_sets_and_marginals_are_shown_in_a_line() -> None:
    belief = belief_of(draw(50, 0))
    for one in (belief.credible_set(0.9), belief.marginal("z")):
        assert "\n" not in repr(one)
        assert len(repr(one)) < 80


def test_density_has_the_shape_of_what_is_asked() -> None:
    belief = belief_of(draw(60, 3))
    asked = draw(6, 4).reshape(2, 3, 4, 4)
    found = belief.log_density(asked)
    assert found.shape == (2, 3)
    assert found[1, 2] == pytest.approx(float(belief.log_density(asked[1, 2])))


def test_a_symmetric_object_turned_is_as_likely_and_as_much_in_the_set() -> None:
    belief = belief_of(draw(200, 5), symmetries=half_turn())
    fresh = draw(50, 6)
    turned = fresh @ half_turn()[1]
    assert np.allclose(belief.log_density(turned), belief.log_density(fresh))
    assert (belief.contains(turned) == belief.contains(fresh)).all()
    assert belief.contains(fresh).mean() > 0.7
    assert not belief_of(draw(200, 5)).contains(turned).any()


def test_modes_that_a_symmetry_makes_of_one_another_are_named_as_such() -> None:
    tight = draw(90, 7, SCALE / 3)
    both = np.concatenate([tight, tight[:30] @ half_turn()[1]])
    found = belief_of(both, symmetries=half_turn()).modes
    assert [mode.equivalent for mode in found] == [None, 0]
    assert [mode.equivalent for mode in belief_of(both).modes] == [None, None]


def test_marginals_have_their_axis_own_quantiles() -> None:
    belief = belief_of(draw(4000, 8))
    z, turn = belief.marginal("z"), belief.marginal("ry")
    at = (middle().numpy() @ np.append(CENTER, 1))[2]
    assert (z.mean, z.std) == pytest.approx((at, 0.008), abs=4e-4)
    assert z.deviation == z.std  # by its earlier name
    assert z.quantile(0.5) == pytest.approx(at, abs=5e-4)
    low, high = turn.interval(0.9)
    assert (low, high) == pytest.approx((-1.645 * 0.05, 1.645 * 0.05), abs=0.006)
    assert (z.quantile(0), z.quantile(1)) == (z.values.min(), z.values.max())
    weighted = dataclasses.replace(
        z, values=np.array([3.0, 1.0, 2.0]), weights=np.array([0.7, 0.1, 0.2])
    )
    assert [weighted.quantile(q) for q in (0.05, 0.2, 0.3, 0.31)] == [1, 2, 2, 3]
    with pytest.raises(UserError, match="roll"):
        belief.marginal("roll")
    with pytest.raises(UserError, match=r"the quantile q is between 0 and 1, and -0\.1 is not"):
        z.quantile(-0.1)


def test_words_say_the_distance_that_the_share_of_the_particles_keeps() -> None:
    belief = belief_of(draw(1200, 9))
    sure = belief.uncertainty(0.95)
    shifts = np.linalg.norm(np.random.default_rng(0).normal(size=(200_000, 3)) * SCALE[:3], axis=1)
    turns = np.linalg.norm(np.random.default_rng(1).normal(size=(200_000, 3)) * SCALE[3:], axis=1)
    assert sure.translation == pytest.approx(np.quantile(shifts, 0.95), rel=0.08)
    assert sure.rotation == pytest.approx(np.quantile(turns, 0.95), rel=0.08)
    said = dataclasses.replace(sure, translation=0.0042, rotation=math.radians(3.14), mass=1.0)
    assert said.describe() == "within 4.2 mm and 3.1 degrees (95 %)"
    assert (
        dataclasses.replace(said, mass=0.7)
        .describe()
        .endswith("a pose that has 70 % of the belief")
    )
    mixed = np.concatenate([draw(40, 9, SCALE / 4), draw(20, 10, SCALE / 4) @ half_turn()[1]])
    # equivalent poses in one mode are no uncertainty
    one = belief_of(mixed, symmetries=half_turn()).uncertainty()
    assert one.rotation < 0.1


def test_a_point_of_the_object_lands_where_the_particles_put_it() -> None:
    shifts = np.repeat(middle().numpy()[None], 2, 0)
    shifts[1, 0, 3] += 0.01
    belief = belief_of(shifts, np.array([0.5, 0.5]))
    depth = (shifts[0] @ np.append(CENTER, 1))[2]
    at = belief.project(K)
    pixels = 600 * 0.01 / depth
    assert at.covariance[0] == pytest.approx(np.diag([(pixels / 2) ** 2, 0]), abs=1e-9)
    assert at.radius[0] == pytest.approx(pixels / 2)
    place = shifts.mean(0) @ np.append(CENTER, 1)
    assert at.mean[0] == pytest.approx((K @ (place[:3] / place[2]))[:2])
    assert belief.project(K, np.zeros((5, 3))).covariance.shape == (5, 2, 2)


def test_symmetries_are_saved_and_files_without_them_are_read(tmp_path: Path) -> None:
    belief = belief_of(draw(30, 11), symmetries=half_turn())
    belief.save(tmp_path / "new.npz")
    again = Belief.load(tmp_path / "new.npz")
    assert np.allclose(again.symmetries, half_turn())
    asked = draw(8, 12)
    assert np.allclose(again.log_density(asked), belief.log_density(asked), atol=0.02)
    with np.load(tmp_path / "new.npz") as stored:
        arrays = {name: stored[name] for name in stored.files if name != "symmetries"}
    np.savez(tmp_path / "old.npz", **arrays)
    assert np.allclose(Belief.load(tmp_path / "old.npz").symmetries, np.eye(4)[None])
    for name, symmetries in (
        ("flat", np.eye(4)),
        ("mirror", np.diag([-1.0, 1, 1, 1])[None]),
        ("many", np.repeat(np.eye(4)[None], 10_001, 0)),
        ("other", half_turn()[1:]),  # as BOP lists them, without the identity
    ):
        np.savez(tmp_path / f"{name}.npz", **arrays, symmetries=symmetries)
        with pytest.raises(UserError, match=f"{name}.npz: belief: .*symmetries") as caught:
            Belief.load(tmp_path / f"{name}.npz")
        assert "\n" not in str(caught.value)


def test_a_ball_has_a_belief_too() -> None:
    """Its symmetries are 36 squared turns, where nothing else is set."""
    lines = [(axis, CENTER) for axis in np.eye(3)[:2]]
    ball = symmetry_group(continuous=lines)
    belief = belief_of(draw(20, 13), symmetries=ball)
    assert len(belief.symmetries) == 36**2
    assert np.isfinite(belief.covariance_about(middle().numpy())).all()


def test_poses_of_three_rows_are_taken_and_what_is_no_pose_is_refused() -> None:
    samples = np.tile(np.eye(4), (50, 1, 1))
    samples[:, :3, 3] = np.random.default_rng(0).normal((0, 0, 1), 0.01, (50, 3))
    belief = Belief(samples, np.full(50, 0.02), np.zeros(3), 0.1, 0.2)
    pose = samples[0]
    assert belief.log_density(pose[:3]) == belief.log_density(pose)
    assert belief.contains(samples[:2, :3]).shape == (2,)
    for wrong in (2 * pose, np.full((4, 4), np.nan), pose[:3, :3]):
        with pytest.raises(UserError, match=r"^poses: "):
            belief.contains(wrong)
    one, many = (belief.project(K, np.array(x)) for x in ([0.01, 0.02, 0.03], [[0.01, 0.02, 0.03]]))
    np.testing.assert_array_equal(one.mean, many.mean)
    assert one.mean.shape == (1, 2)
    with pytest.raises(UserError, match="points: have shape"):
        belief.project(K, np.zeros((2, 4)))


def test_a_file_is_found_by_the_name_that_it_was_saved_by(tmp_path: Path) -> None:
    samples = np.tile(np.eye(4), (5, 1, 1))
    belief = Belief(samples, np.full(5, 0.2), np.zeros(3), 0.1, 0.2, "duck")
    belief.save(tmp_path / "belief")
    (tmp_path / "folder").mkdir()
    with pytest.raises(UserError, match=r"folder: is a folder; name the file to write$"):
        belief.save(tmp_path / "folder")
    assert not (tmp_path / "folder.npz").exists()
    with pytest.raises(UserError, match=r"folder: is a folder; name the file to read$"):
        Belief.load(tmp_path / "folder")
    for use in (belief.save, Belief.load):
        with pytest.raises(UserError, match=r"^None: expected the path of a belief's file$"):
            use(None)  # type: ignore[operator]
    with np.load(tmp_path / "belief.npz") as stored:
        named = set(re.findall(r"`(\w+)`", Belief.save.__doc__.split("arrays are")[1]))  # type: ignore[union-attr]
        assert set(stored.files) == named
    assert (tmp_path / "belief.npz").is_file()
    for name in ("belief", "belief.npz"):
        assert Belief.load(tmp_path / name).object == "duck"
    with pytest.raises(UserError, match="no such file"):
        Belief.load(tmp_path / "other")


def test_what_is_no_level_and_no_camera_is_refused() -> None:
    belief = belief_of(draw(50, 0))
    with pytest.raises(UserError, match="quantile q is between 0 and 1"):
        belief.marginal("x").quantile([0.1, 0.5])  # type: ignore[arg-type]
    with pytest.raises(UserError, match="level is between 0 and 1, and 90 is not"):
        belief.marginal("x").interval(90)
    with pytest.raises(UserError, match="level is between 0 and 1"):
        belief.marginal("x").interval(-0.5)
    with pytest.raises(UserError, match=r"intrinsics: have shape \(4, 4\)"):
        belief.project(np.eye(4))
    for wrong, said in ((K.T, "transposed"), (np.nan * K, "NaN"), ("K", "no numbers")):
        with pytest.raises(UserError, match=rf"^intrinsics: .*{said}"):
            belief.project(wrong)  # type: ignore[arg-type]


def test_what_is_no_point_and_no_pose_is_refused() -> None:
    belief = belief_of(draw(50, 0))
    for points in (0.1, [np.nan, 0, 0]):
        with pytest.raises(UserError, match=r"^points: "):
            belief.project(K, points)  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"^belief: poses should be numbers"):
        belief.log_density("a")  # type: ignore[arg-type]


def test_a_seed_may_be_a_number_of_numpy_and_what_is_none_is_refused() -> None:
    belief = belief_of(draw(50, 0))
    np.testing.assert_array_equal(belief.draw(3, np.int64(7)), belief.draw(3, 7))
    np.testing.assert_array_equal(
        belief.fuse(belief, 5, np.int32(7)).samples, belief.fuse(belief, 5, 7).samples
    )
    for seed in (1.5, -1, None):
        with pytest.raises(UserError, match=r"^seed=.*: must be a whole number"):
            belief.draw(3, seed)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="another Belief, not with None"):
        belief.fuse(None)  # type: ignore[arg-type]


def test_a_belief_stays_what_it_is_where_the_array_that_it_was_made_of_changes() -> None:
    samples = draw(50, 0)
    belief = belief_of(samples)
    samples[:] = np.eye(4)
    np.testing.assert_array_equal(belief.samples, draw(50, 0))


def any_turn(steps: int = 36) -> np.ndarray:
    """Return a continuous symmetry about the object's z, cut into turns as meshes have it."""
    return symmetry_group(continuous=[(np.array([0.0, 0, 1]), CENTER)], steps=steps)


def test_modes_that_a_symmetry_makes_of_one_another_are_one_place_with_one_share() -> None:
    tight = draw(90, 7, SCALE / 3)
    far = tight[:10].copy()
    far[:, 0, 3] += 0.2
    turned = tight[:30] @ half_turn()[1]
    both = belief_of(np.concatenate([tight, turned, far]), symmetries=half_turn())
    assert [mode.equivalent for mode in both.modes] == [None, 0, None]
    assert both.modes[0].mass == pytest.approx(90 / 130)
    sure = both.uncertainty()
    assert sure.mass == pytest.approx(120 / 130)
    assert sure.describe().endswith("a pose that has 92 % of the belief")
    # the particles of the equivalent mode count, too
    wide = draw(60, 8) @ half_turn()[1]
    mixed = belief_of(np.concatenate([tight, wide]), symmetries=half_turn())
    alone = belief_of(tight, symmetries=half_turn()).uncertainty()
    assert mixed.uncertainty().translation > 1.5 * alone.translation
    # without the symmetry they are other poses
    assert belief_of(both.samples).uncertainty().mass == pytest.approx(90 / 130)


def test_a_turn_about_a_continuous_symmetry_is_no_uncertainty() -> None:
    """36 turns of 10 degrees leave gaps of 5 degrees on either side."""
    angles = np.random.default_rng(13).uniform(0, 2 * np.pi, 300)
    turns = torch.from_numpy(np.outer(angles, [0.0, 0, 1]))
    twists = torch.cat([torch.zeros(300, 3).double(), turns], dim=1)
    samples = move_about(middle().expand(300, 4, 4), twists, torch.from_numpy(CENTER)).numpy()
    sure = belief_of(samples, symmetries=any_turn()).uncertainty()
    assert math.degrees(sure.rotation) < 0.61
    assert sure.translation == pytest.approx(0, abs=1e-9)
    assert sure.mass > 0.95


def test_turned_poses_stay_in_the_sets_of_a_belief_that_was_brought_together() -> None:
    scale = np.array([0.002, 0.002, 0.002, 0.02, 0.02, 0.02])
    belief = belief_of(draw(200, 21, scale), symmetries=any_turn())
    other = belief_of(draw(200, 22, scale), symmetries=any_turn())
    pose = middle().numpy()
    for one in (belief, belief.canonicalize(pose), belief.fuse(other)):
        density = []
        for degrees in (0.0, 2.5, 5.0, 7.5, 90.0, 123.0):
            turn = torch.tensor([0, 0, 0, 0, 0, math.radians(degrees)]).double()
            turned = move_about(middle(), turn, torch.from_numpy(CENTER)).numpy()
            density.append(float(one.log_density(turned)))
            assert one.contains(turned, 0.9)
        assert np.ptp(density) < 1.5
    assert belief.fuse(other).differential_entropy < belief.differential_entropy


def test_the_covariance_about_a_pose_holds_its_offset_and_forgets_the_symmetry() -> None:
    samples = draw(3000, 14)
    offset = np.array([0.003, -0.001, 0.002, 0.0, 0.0, 0.0])
    pose = middle().clone()
    pose[:3, 3] -= torch.from_numpy(offset[:3])
    flipped = np.random.default_rng(15).random(3000) < 0.5
    mixed = samples.copy()
    mixed[flipped] = mixed[flipped] @ half_turn()[1]
    expected = np.diag(SCALE**2) + np.outer(offset, offset)
    unit = np.outer(SCALE, SCALE)
    for belief in (belief_of(samples), belief_of(mixed, symmetries=half_turn())):
        found = belief.covariance_about(pose.numpy())
        assert np.abs((found - expected) / unit).max() < 0.12
        assert np.array_equal(found, belief.covariance_about(pose.numpy()[:3]))
    about_mean = belief_of(samples).covariance_about(belief_of(samples).mean)
    assert np.allclose(about_mean, belief_of(samples).covariance, atol=1e-15)
    assert belief_of(mixed, symmetries=half_turn()).covariance[5, 5] > 1
    with pytest.raises(UserError, match="poses: should be rigid"):
        belief_of(samples).covariance_about(2 * np.eye(4))
    with pytest.raises(UserError, match=r"pose: has shape \(2, 4, 4\)"):
        belief_of(samples).covariance_about(samples[:2])


def test_the_covariance_of_an_error_leaves_other_modes_out_where_draws_are_known() -> None:
    pose = middle().numpy()
    own, away = draw(400, 16), draw(100, 17)
    away[:, 0, 3] += 0.2
    weights = np.concatenate([np.full(400, 0.75 / 400), np.full(100, 0.25 / 100)])
    samples = np.concatenate([own, away])
    calibrated = belief_of(samples, weights, draws=400)
    alone = belief_of(own).covariance_about(pose)
    assert np.allclose(calibrated.error_covariance(pose), alone, rtol=1e-9, atol=1e-15)
    about = calibrated.covariance_about(pose)
    assert about[0, 0] == pytest.approx(0.25 * 0.2**2, rel=0.05)
    plain = belief_of(samples, weights)  # whose draws are not known
    assert np.array_equal(plain.error_covariance(pose), about)
    with pytest.raises(UserError, match="poses: should be rigid"):
        calibrated.error_covariance(2 * np.eye(4))


def test_a_canonical_belief_is_the_same_belief_in_one_place() -> None:
    samples = draw(200, 16)
    turned = samples.copy()
    turned[:90] = turned[:90] @ half_turn()[1]
    belief = belief_of(turned, np.random.default_rng(17).random(200), symmetries=half_turn())
    one = belief.canonicalize(middle().numpy())
    assert np.allclose(one.samples, samples)
    assert np.array_equal(one.weights, belief.weights)
    assert np.allclose(one.log_density(draw(20, 18)), belief.log_density(draw(20, 18)), atol=1e-6)
    assert one.marginal("rz").std == pytest.approx(SCALE[5], rel=0.2)
    assert belief.marginal("rz").std > 1
    plain = belief_of(turned)
    assert np.array_equal(plain.canonicalize(middle().numpy()).samples, turned)
    ring = belief_of(samples @ any_turn()[7], symmetries=any_turn())
    about = ring.canonicalize(middle().numpy()).marginal("rz")
    assert np.abs(about.values - about.mean).max() < math.radians(0.7)


def test_a_belief_of_another_frame_is_the_same_belief_there() -> None:
    belief = belief_of(draw(300, 19), symmetries=half_turn())
    turn = exp_so3(torch.tensor([0.9, 0.2, -1.4]).double())
    frame = make_pose(turn, torch.tensor([1.0, -2.0, 0.5]).double()).numpy()
    there = belief.transform(frame[:3])
    assert np.allclose(there.mean, frame @ belief.mean)
    both = np.eye(6)
    both[:3, :3] = frame[:3, :3]
    assert np.allclose(there.covariance, both @ belief.covariance @ both.T, atol=1e-15)
    asked = draw(20, 20)
    assert np.allclose(there.log_density(frame @ asked), belief.log_density(asked), atol=1e-6)
    assert there.differential_entropy == pytest.approx(belief.differential_entropy, abs=1e-6)
    assert np.allclose(there.transform(np.linalg.inv(frame)).samples, belief.samples)
    assert (there.object, len(there.symmetries)) == ("thing", 2)
    with pytest.raises(UserError, match="rigid"):
        belief.transform(np.diag([2.0, 2, 2, 1]))


def test_draws_are_of_the_density_and_apart_where_samples_are_copies() -> None:
    """Few samples, each many times, as resampling leaves them."""
    few = draw(150, 21)
    copies = np.random.default_rng(22).integers(0, 150, 400)
    belief = belief_of(few[copies])
    drawn = belief.draw(3000)
    assert len(np.unique(drawn[:, 0, 3])) == 3000
    assert np.array_equal(drawn, belief.draw(3000))
    assert not np.allclose(drawn, belief.draw(3000, seed=1))
    wider = belief_of(drawn).covariance.diagonal() / belief.covariance.diagonal()
    assert (wider > 0.95).all()
    assert (wider < 2.2).all()
    assert np.allclose(belief_of(drawn).mean, belief.mean, atol=0.01)
    # under another density p, draws of q tell its integral: the mean of p / q is 1
    other = belief_of(draw(400, 27, 0.6 * SCALE))
    ratio = np.exp(other.log_density(drawn) - belief.log_density(drawn))
    assert ratio.mean() == pytest.approx(1, abs=5 * ratio.std() / np.sqrt(3000) + 0.02)
    far = draw(100, 28)
    far[:, 2, 3] += 0.5
    heavy = belief_of(np.concatenate([few[:100], far]), np.repeat([0.75, 0.25], 100))
    assert (heavy.draw(400)[:, 2, 3] < 1.2).sum() == pytest.approx(300, abs=1)
    for wrong in (0, -1, 2.5, True):
        with pytest.raises(UserError, match="whole number, 1 or more"):
            belief.draw(wrong)  # type: ignore[arg-type]


@pytest.mark.slow
def test_two_views_are_fused_by_bayes_rule() -> None:
    """One knows x, the other y; of Gaussians the product is known."""
    first, second = SCALE.copy(), SCALE.copy()
    first[1], second[0] = 0.02, 0.02
    shift = np.array([0.002, 0.004, 0.004])
    aside = draw(600, 24, second)
    aside[:, :3, 3] += shift
    one, two = belief_of(draw(600, 23, first)), belief_of(aside)
    fused = one.fuse(two, count=1200)
    a, b = 1 / first**2, 1 / second**2
    place = (middle().numpy() @ np.append(CENTER, 1))[:3] + b[:3] / (a + b)[:3] * shift
    std = 1 / np.sqrt(a + b)
    for axis, at, wide in zip("xyz", place, std, strict=False):
        found = fused.marginal(axis)
        assert found.mean == pytest.approx(at, abs=0.4 * wide)
        # both densities are wider than what their particles were drawn from
        assert 0.9 * wide < found.std < 1.7 * wide
    for number, axis in ((3, "rx"), (4, "ry"), (5, "rz")):
        assert 0.9 * std[number] < fused.marginal(axis).std < 1.7 * std[number]
    assert fused.differential_entropy < min(one.differential_entropy, two.differential_entropy) - 1
    assert len(fused.weights) == 2400
    again = two.fuse(one, count=1200)
    assert np.allclose(again.mean, fused.mean, atol=0.01)


def test_views_that_contradict_each_other_are_both_kept_and_symmetries_are_known() -> None:
    tight = draw(200, 25, SCALE / 3)
    far = np.repeat(move_far(np.eye(4))[None], 200, 0) @ tight
    modes = belief_of(tight).fuse(belief_of(far)).modes
    assert [mode.mass for mode in modes[:2]] == pytest.approx([0.5, 0.5], abs=0.2)
    turned = tight @ half_turn()[1]
    one, two = belief_of(tight, symmetries=half_turn()), belief_of(turned, symmetries=half_turn())
    fused = one.fuse(two)
    assert fused.differential_entropy < one.differential_entropy - 1
    assert np.sqrt(fused.covariance.diagonal()[5]) < SCALE[5]
    with pytest.raises(UserError, match="is another object than thing"):
        one.fuse(dataclasses.replace(two, diameter=0.3))
