"""A tolerance of the user's own: what it accepts, and the probability of keeping it."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from posefilter.confidence.calibration import read_calibration
from posefilter.confidence.fit import Frames, cross_validate, fit_calibration, make_frames
from posefilter.confidence.tolerance import (
    RIGHT,
    PoseErrors,
    PoseTolerance,
    measure_pose_errors,
    read_pose_tolerance,
)
from posefilter.confidence.verdicts import Costs, apply_prior
from posefilter.errors import UserError
from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import exp_so3
from posefilter.meshes.symmetries import rotation_about, symmetry_group
from posefilter.metrics.confidence import calibration_error
from posefilter.result import Result
from posefilter.types import ObjectModel

NAMES = ("a", "b")
LIMIT = 0.08  # of ADD and ADD-S, at which the planted share is one half


def draw(count: int, seed: int = 0) -> Frames:
    """Draw frames of which half show the object: the feature b scales the error of the pose."""
    rng = np.random.default_rng(seed)
    there = rng.random(count) < 0.5
    x = rng.normal(size=(count, 2))
    x[:, 0] += np.where(there, 2.0, -2.0)
    # log error = noise of a logistic distribution less b: the share below a limit is logistic in b
    error = LIMIT * np.exp(rng.logistic(size=count) - x[:, 1])
    off = [np.where(there, scale * error, np.nan) for scale in (0.1, 2.0, 1.0, 0.5)]
    errors = PoseErrors(*off)
    return Frames(NAMES, x, there, RIGHT.accepts(errors), errors=errors)


@pytest.mark.parametrize("limit", [0.02, 0.08, 0.3])
def test_the_probability_is_the_share_that_keeps_the_tolerance(limit: float) -> None:
    frames = draw(20_000)
    made = fit_calibration(frames, "scenes")
    found = made.assess_features(torch.from_numpy(frames.values), PoseTolerance(add=limit))
    z = frames.values[:, 1] + math.log(limit / LIMIT)
    planted = found.presence.numpy() / (1 + np.exp(-z))
    inside = (np.abs(frames.values) < 3).all(1)
    assert np.abs(found.probability.numpy() - planted)[inside].max() < 0.04
    half = made.assess_features(torch.from_numpy(frames.values), PoseTolerance(add_s=limit / 2))
    assert torch.allclose(half.probability, found.probability)  # ADD-S is half of ADD here


def test_it_is_calibrated_on_frames_that_it_has_not_seen() -> None:
    made, held = fit_calibration(draw(2000), "scenes"), draw(4000, seed=1)
    assert held.errors is not None
    for tolerance in (
        PoseTolerance(add_s=0.1),
        PoseTolerance(translation_mm=4),
        PoseTolerance(translation_mm=20, rotation_deg=10),
    ):
        found = made.assess_features(torch.from_numpy(held.values), tolerance)
        right = torch.from_numpy(tolerance.accepts(held.errors))
        assert 0.1 < float(right.double().mean()) < 0.5
        assert float(calibration_error(found.probability, right)) < 0.03


def test_the_usual_tolerance_has_the_usual_probability() -> None:
    frames = draw(300)
    made = fit_calibration(frames, "scenes")
    rows = torch.from_numpy(frames.values)
    usual, named = made.assess_features(rows), made.assess_features(rows, PoseTolerance(add=0.1))
    assert torch.equal(usual.probability, named.probability)
    # and so has the regression that is fitted when it is asked for, to features of float16
    nearly = made.assess_features(rows, PoseTolerance(add=0.1 + 1e-12))
    assert torch.allclose(usual.probability, nearly.probability, atol=1e-3)


def test_a_tolerance_that_all_keep_or_none_leaves_doubt() -> None:
    frames = draw(100)
    made = fit_calibration(frames, "scenes")
    rows = torch.from_numpy(frames.values[frames.present])
    every = made.assess_features(rows, PoseTolerance(add=1e6))
    assert bool((every.probability <= every.presence * 0.995).all())
    assert bool((every.probability > every.presence * 0.9).all())
    none = made.assess_features(rows, PoseTolerance(add=1e-9))
    assert bool((none.probability > 0).all())
    assert float(none.probability.max()) < 0.1


def test_errors_survive_as_plain_data_and_are_checked() -> None:
    made = fit_calibration(draw(200), "scenes")
    plain = made.to_plain()
    assert read_calibration(plain, "x") == made
    given = plain["errors"]
    del plain["errors"]
    old = read_calibration(plain, "x")
    assert old == replace(made, errors=None)
    with pytest.raises(UserError, match="earlier version"):
        old.fit_success(PoseTolerance(add_s=0.1))
    far = torch.cat([given[:, :2] + 10, given[:, 2:]], 1)
    for wrong in (
        given.tolist(), given[:0], given[0], given[:, 1:], given.long(), given.float(), -given,
        given * math.nan, far, {"errors": given},
    ):  # fmt: skip
        with pytest.raises(UserError, match="errors"):
            read_calibration({**plain, "errors": wrong}, "x")


def test_frames_without_errors_make_a_calibration_that_knows_one_tolerance() -> None:
    frames = draw(200)._replace(errors=None)
    made = fit_calibration(frames, "scenes")
    assert made.errors is None
    assert len(cross_validate(frames).presence) == 200


def test_numbers_must_be_positive_and_one_given() -> None:
    assert read_pose_tolerance(None) is None
    assert read_pose_tolerance({"add": None, "add_s": None}) is None
    assert read_pose_tolerance({"add": None, "add_s": 0.1}) == PoseTolerance(add_s=0.1)
    with pytest.raises(UserError, match="gives none of translation_mm"):
        PoseTolerance()
    assert PoseTolerance(rotation_deg=np.float32(5)) == PoseTolerance(rotation_deg=5)
    assert Costs(miss=np.int64(2), unsure=np.float32(1)) == Costs(miss=2)
    assert apply_prior(0.5, 0.4, np.float32(0.25))[0] == 0.25  # type: ignore[arg-type]
    for wrong in (0, -1, math.inf, math.nan, True, "5"):
        with pytest.raises(UserError, match=r"pose_tolerance\.rotation_deg="):
            PoseTolerance(rotation_deg=wrong)  # type: ignore[arg-type]


def test_another_cost_is_judged_by_the_same_tolerance_unless_another_is_given() -> None:
    own = PoseTolerance(translation_mm=5)
    result = SimpleNamespace(
        blank="",
        presence=0.95,
        wrong_size=False,
        pose_tolerance=own,
        probability_within=lambda tolerance: 0.9 if tolerance == RIGHT else 0.3,
    )
    assert Result.decide(result, Costs()) == "unsure"  # type: ignore[arg-type]
    assert Result.decide(result, Costs(), RIGHT) == "found"  # type: ignore[arg-type]
    for wrong in ((5,), (Costs(), 0.05)):
        with pytest.raises(UserError, match=r"expected posefilter\.(Costs|PoseTolerance)\("):
            Result.decide(result, *wrong)
    result.pose_tolerance = None
    assert Result.decide(result, Costs()) == "found"  # type: ignore[arg-type]


def test_all_that_is_given_must_be_kept_and_is_said() -> None:
    errors = PoseErrors(*np.array([[0.004, 0.004, 0.006], [0.1, 0.2, 0.1], [0.05] * 3, [0.02] * 3]))
    both = PoseTolerance(translation_mm=5, rotation_deg=10)
    assert both.accepts(errors).tolist() == [True, False, False]
    assert both.describe() == "within 5 mm and 10 degrees"
    assert PoseTolerance(add_s=0.1).describe() == "within ADD-S 0.1 d"


def make_model(symmetries: torch.Tensor) -> ObjectModel:
    """A rod of points along z, half a meter beside its mesh's origin."""
    points = torch.zeros(50, 3)
    points[:, 0], points[:, 2] = 0.5, torch.linspace(-0.1, 0.1, 50)
    center = torch.tensor([0.5, 0.0, 0.0])
    return ObjectModel(
        name="rod",
        points=points,
        hull=points,
        center=center,
        radius=0.1,
        diameter=0.2,
        symmetries=symmetries,
    )


def test_errors_are_of_the_center_and_up_to_symmetry() -> None:
    eye = torch.eye(4, dtype=torch.float64)
    about = torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64)
    turn = exp_so3(torch.tensor([0.0, math.pi, 0.0], dtype=torch.float64))
    half = make_pose(turn, about - turn @ about)  # a half turn about the center
    tilt = exp_so3(torch.tensor([0.0, 0.1, 0.0], dtype=torch.float64))
    near = make_pose(tilt, about - tilt @ about + torch.tensor([0.003, 0.0, 0.004]))
    poses, truth = torch.stack([near, near @ half]), torch.stack([eye, eye])
    plain = measure_pose_errors(poses, truth, make_model(eye[None].float()))
    assert plain.translation.tolist() == pytest.approx([0.005, 0.005], abs=1e-9)
    assert plain.rotation.tolist() == pytest.approx([0.1, math.pi - 0.1], abs=1e-6)
    assert float(plain.add[1]) > 5 * float(plain.add[0])
    assert float(plain.add_s[1]) == pytest.approx(float(plain.add_s[0]), abs=1e-6)
    both = measure_pose_errors(poses, truth, make_model(torch.stack([eye, half]).float()))
    assert both.rotation.tolist() == pytest.approx([0.1, 0.1], abs=1e-6)
    assert float(both.add[1]) == pytest.approx(float(both.add[0]), abs=1e-6)
    assert bool((both.add_s <= both.add).all())


def test_a_turn_about_a_continuous_symmetry_is_no_error() -> None:
    """The object knows 36 turns; a pose between two of them is right all the same."""
    axis, point = np.array([0.6, 0.0, 0.8]), np.array([0.5, 0.1, 0.0])
    group = torch.from_numpy(symmetry_group(continuous=[(axis, point)], steps=36))
    truth = make_pose(exp_so3(torch.tensor([0.3, -0.2, 0.5])), torch.tensor([0.1, 0.2, 0.9]))
    truth = truth.double()[None]
    between = torch.from_numpy(rotation_about(axis, math.radians(5), point))
    errors = measure_pose_errors(truth @ between, truth, make_model(group.float()))
    assert math.degrees(float(errors.rotation)) < 0.61
    assert bool(PoseTolerance(rotation_deg=2).accepts(errors).all())
    alone = measure_pose_errors(truth @ between, truth, make_model(group[:1].float()))
    assert math.degrees(float(alone.rotation)) == pytest.approx(5, abs=1e-3)
    assert float(errors.add) < 0.15 * float(alone.add)


def test_an_estimate_that_is_not_finite_is_infinitely_far_off() -> None:
    eye = torch.eye(4, dtype=torch.float64)
    model = make_model(eye[None].float())
    errors = measure_pose_errors(torch.stack([eye * math.nan, eye]), eye.expand(2, 4, 4), model)
    for part in errors:
        assert part[0] == math.inf
        assert float(part[1]) == pytest.approx(0, abs=1e-6)
    assert PoseTolerance(add=0.1).accepts(errors).tolist() == [False, True]


def test_what_is_not_finite_is_calibrated_with_and_read_again() -> None:
    """Of a filter whose arithmetic fails in some image."""
    rng = np.random.default_rng(0)
    values = [{name: torch.from_numpy(rng.normal(size=60)) for name in NAMES}]
    values[0]["a"][3], values[0]["b"][7] = -math.inf, math.nan
    there = np.arange(60) < 40
    off = [np.where(there, rng.uniform(0, 0.2, 60), np.nan) for _ in range(4)]
    for one in off:
        one[5] = math.inf
    frames = make_frames(values, [there], [PoseErrors(*off)], [np.full(len(there), 0.5)])
    assert not frames.correct[5]
    made = fit_calibration(frames, "fat")
    assert read_calibration(made.to_plain(), "x") == made
