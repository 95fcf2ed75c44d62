"""The tracker on a likelihood that is made by hand: it follows, notices a loss, and recovers."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from tests.tracking.toy import DEPTH, RGB, SPACE, K, make_toy, walk_pose

import posefilter
from posefilter.confidence.belief_scale import BeliefScale
from posefilter.confidence.calibration import (
    Assessment,
    Calibration,
    Logistic,
    tabulate_errors,
)
from posefilter.confidence.conformal import Conformal
from posefilter.confidence.fit import Frames, fit_calibration
from posefilter.confidence.scale_ratio import ScaleRatio
from posefilter.confidence.tolerance import RIGHT, PoseErrors, PoseTolerance
from posefilter.errors import UserError
from posefilter.estimator import Estimator
from posefilter.filters.icp import PointToPlaneIcp
from posefilter.filters.refine import Compose
from posefilter.filters.texture import TextureRotations
from posefilter.geometry.rotation import random_rotation
from posefilter.models.pose_particles import require_depth
from posefilter.nets.pose_votes import measure_cells
from posefilter.tracking.components import RotateTogether
from posefilter.tracking.motion import ConstantVelocity
from posefilter.tracking.objectness import measure_objectness
from posefilter.tracking.settings import FilterSettings, TrackerSettings
from posefilter.tracking.track_loss import TrackLossDetector
from posefilter.types import Batch, BeliefBatch

NONE = np.zeros_like(DEPTH)
BLACK = np.zeros_like(RGB)


def off(result: posefilter.TrackResult, truth: torch.Tensor) -> float:
    """Return how far an estimate is off, turns counted at the radius [m]."""
    return float(SPACE.distance(torch.from_numpy(result.pose).float(), truth))


def test_a_moving_object_is_followed_with_few_particles() -> None:
    toy, estimator = make_toy()
    tracker = posefilter.Tracker(estimator)
    truth = walk_pose(20)
    for number, pose in enumerate(truth):
        toy.truth = pose
        result = tracker.update(RGB, DEPTH, K)
        assert result.status == ("tracked" if number else "started")
        assert result.is_tracked
        assert off(result, pose) < 0.008
        assert result.objectness > 0.8
        if number:
            assert result.particles < 150 < toy.filter.particles
    assert result.object == "toy"
    assert result.belief.weights.sum() == pytest.approx(1)


def test_the_seed_is_the_trackers_own_in_every_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever else the estimator is used for between frames."""
    toy, estimator = make_toy()
    tracker = posefilter.Tracker(estimator, seed=1)
    seeds = []
    encode = toy.encode
    monkeypatch.setattr(toy, "encode", lambda batch: (seeds.append(toy.seed), encode(batch))[1])
    for pose in walk_pose(3):
        toy.truth = pose
        tracker.update(RGB, DEPTH, K)
        toy.seed = 99  # as `predict` with another seed leaves it
    assert len(seeds) >= 3
    assert set(seeds) == {1}


@pytest.mark.parametrize("shift", [0.03, 0.06])
def test_an_object_that_starts_to_move_fast_is_followed(shift: float) -> None:
    """The noise grows by itself; a random walk of 5 mm stays behind by over a frame's motion."""
    off_by = []
    for motion in (ConstantVelocity(), ConstantVelocity(velocity_gain=0, max_noise_scale=1)):
        toy, estimator = make_toy()
        tracker = posefilter.Tracker(estimator, TrackerSettings(motion=motion, whole_image_every=0))
        start, distances = walk_pose(1)[0], []
        for number in range(14):
            moved = 0.001 * number + shift * max(0, min(number - 5, 5))
            toy.truth = SPACE.move(start, torch.tensor([moved, 0, 0, 0, 0, 0]))
            result = tracker.update(RGB, DEPTH, K)
            distances.append(off(result, toy.truth))
        assert max(distances[:6]) < 0.01
        off_by.append(max(distances[7:]))
    assert off_by[0] < 0.6 * shift < shift < off_by[1]


def test_a_track_is_aligned_as_single_images_of_the_object_are() -> None:
    toy, estimator = make_toy()
    (track,) = posefilter.Tracker(estimator).tracks
    track.method.capabilities = frozenset({*track.method.capabilities, "depth"})
    for refine, noise in (
        (PointToPlaneIcp(noise=0.008), 0.008),
        (Compose([toy.filter.refine, PointToPlaneIcp(noise=0.006)]), 0.006),
        (toy.filter.refine, PointToPlaneIcp().noise),
    ):
        toy.filter.refine = refine
        icp = track._refine(1).components[-1]
        assert isinstance(icp, PointToPlaneIcp)
        assert (icp.noise, icp.prior) == (noise, TrackerSettings().icp_prior)
        assert icp.iterations < PointToPlaneIcp().iterations


def test_the_network_sees_a_window_and_now_and_then_the_whole_image() -> None:
    toy, estimator = make_toy()
    tracker = posefilter.Tracker(estimator, TrackerSettings(whole_image_every=4, window_side=64))
    truth = walk_pose(13, shift=0.0, turn=0.0)
    for pose in truth:
        toy.truth = pose
        toy.encoded.clear()
        tracker.update(RGB, DEPTH, K)
        whole = (tracker.tracks[0].frames - 1) % 4 == 0
        assert ((120, 160) in toy.encoded) == whole
        assert whole or max(toy.encoded[0]) <= 64


def test_the_network_proposes_poses_where_it_sees_the_whole_image(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    toy, estimator = make_toy()
    tracker = posefilter.Tracker(estimator, TrackerSettings(whole_image_every=3, window_side=64))
    toy.truth = walk_pose(1)[0]
    tracker.update(RGB, DEPTH, K)
    asked, propose = [], toy.propose_poses
    monkeypatch.setattr(
        toy, "propose_poses", lambda *given: (asked.append(given[1]), propose(*given))[1]
    )
    for frame in range(1, 10):
        asked.clear()
        toy.encoded.clear()
        result = tracker.update(RGB, DEPTH, K)
        whole = frame % 3 == 0
        assert ((120, 160) in toy.encoded) == whole
        # of the motion in the first frame nothing is known
        times = [3] if frame == 1 else [1] if whole else []
        assert asked == [n * tracker.settings.follow.proposals for n in times]
        assert off(result, toy.truth) < 0.01


def test_a_loss_is_noticed_and_the_object_recovered_elsewhere() -> None:
    toy, estimator = make_toy()
    tracker = posefilter.Tracker(estimator)
    truth = walk_pose(12, shift=0.0)
    statuses = []
    for number in range(30):
        away = 8 <= number < 18
        pose = truth[0] if number < 8 else SPACE.move(truth[0], torch.tensor([0.2, 0, 0, 0, 1, 0]))
        toy.truth = None if away else pose
        result = tracker.update(RGB, DEPTH, K)
        statuses.append(result.status)
        assert result.is_tracked == (result.status != "lost")
        # a pose that is a guess is not drawn, and one that was not measured has no score
        assert (result.shown_pose is None) == (result.describe() == "toy: lost")
        assert (result.shown_pose is None) == (result.status == "lost")
        assert (result.score == -math.inf) == (away and number > 0)
        if result.is_tracked and not away:
            assert off(result, pose) < 0.01
    assert statuses[8:10] == ["tracked", "lost"]  # two frames without it are a loss
    assert set(statuses[9:18]) == {"lost"}  # nothing is tracked that is not there
    again = statuses.index("recovered")
    assert 18 <= again < 21
    assert set(statuses[again + 1 :]) == {"tracked"}


@pytest.mark.parametrize(
    ("covered", "near", "penalty", "found"),
    [
        (True, False, 5.0, False),
        (False, False, 5.0, True),
        (True, True, 5.0, True),
        (True, False, 0.0, True),
    ],
)
def test_what_resembles_a_covered_object_elsewhere_must_show_more(
    covered: bool, near: bool, penalty: float, found: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    toy, estimator = make_toy()

    def presence(*_: object) -> tuple[float, None]:
        return 0.0 if toy.truth is None else 0.99 if toy.truth is start else 0.9, None

    monkeypatch.setattr("posefilter.tracking.track.measure_presence", presence)
    tracker = posefilter.Tracker(estimator, TrackerSettings(elsewhere_penalty=penalty))
    start = walk_pose(1)[0]
    shift = torch.tensor([0.05 if near else 0.3, 0, 0, 0, 0, 0])
    other = SPACE.move(start, shift)
    depth = DEPTH if covered else DEPTH + 1  # before the object, or behind it
    for toy.truth in (start, start, start, None, None, None):
        result = tracker.update(RGB, depth, K)
    assert result.status == "lost"
    toy.truth = other
    statuses = [tracker.update(RGB, depth, K).status for _ in range(6)]
    assert ("recovered" in statuses) == found
    # in a second or two it may have been moved
    assert found or "recovered" in [tracker.update(RGB, depth, K).status for _ in range(60)]


@pytest.mark.parametrize("penalty", [5.0, 1000.0])
def test_an_object_that_was_never_tracked_was_not_lost_behind_something(
    penalty: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And what is found of one that was is as doubtful in the result as for the track."""
    toy, estimator = make_toy()
    toy.calibration = Calibration(
        ("score",), (-5.0,), (2.0,), Logistic((3.0,), 0.0), Logistic((3.0,), 0.0),
        {"right": 20, "wrong": 0, "absent": 20}, "toy", {},
    )  # fmt: skip

    def assess(*_: object) -> tuple[float, Assessment]:
        presence = 0.0 if toy.truth is None else 0.99 if toy.truth is start else 0.9
        return presence, Assessment(*(torch.tensor([presence]).double() for _ in range(2)))

    monkeypatch.setattr("posefilter.tracking.track.measure_presence", assess)
    tracker = posefilter.Tracker(estimator, TrackerSettings(elsewhere_penalty=penalty))
    start = walk_pose(1)[0]
    other = SPACE.move(start, torch.tensor([0.3, 0, 0, 0, 0, 0]))
    for toy.truth in (None, None, None):
        assert tracker.update(RGB, DEPTH, K).status == "lost"
    toy.truth = other
    assert "started" in [tracker.update(RGB, DEPTH, K).status for _ in range(3)]
    for toy.truth in (start, start, start, None, None, None):
        result = tracker.update(RGB, DEPTH, K)
    assert result.status == "lost"
    toy.truth = other
    results = [tracker.update(RGB, DEPTH, K) for _ in range(3)]
    assert {one.status for one in results} == {"lost"}
    assert all(one.presence is not None and one.presence < 0.5 for one in results)
    assert all(one.verdict != "found" for one in results)


def test_a_loss_is_noticed_where_the_network_takes_other_pixels_for_the_object() -> None:
    """The calibrated presence tells what the objectness of the pixels does not."""
    toy, estimator = make_toy()
    toy.calibration = Calibration(
        ("score",), (-5.0,), (2.0,), Logistic((3.0,), 0.0), Logistic((3.0,), 0.0),
        {"right": 20, "wrong": 0, "absent": 20}, "toy", {},
    )  # fmt: skip
    tracker = posefilter.Tracker(estimator)
    pose = toy.ghost = walk_pose(1)[0]
    results = []
    for number in range(20):
        toy.truth = None if 6 <= number < 12 else pose
        results.append(tracker.update(RGB, DEPTH, K))
    assert min(one.objectness for one in results[:8]) > 0.8
    assert [one.is_tracked for one in results[6:12]] == [True] + 5 * [False]
    assert all(one.presence < 0.1 and one.probability < one.presence for one in results[6:12])
    assert any(one.is_tracked for one in results[12:15])
    assert results[-1].presence > 0.9
    assert off(results[-1], pose) < 0.008


@pytest.mark.parametrize(("rows", "found"), [(23, 0.0), (18, 1.0)])
def test_an_image_that_is_no_whole_cells_is_read_cell_by_cell(rows: int, found: float) -> None:
    """Of 180 rows in cells of 8, those from 168 to 175 are the last but one's; in 18 cells of 10,
    the last two's.
    """
    objectness = torch.zeros(1, 1, rows, 40 if rows == 23 else 32)
    objectness[:, :, -1] = 1
    if rows == 18:
        objectness[:, :, -2] = 1
    rgb = torch.zeros(1, 3, 180, 320)
    camera = torch.tensor([[[100.0, 0, 160], [0, 100, 172], [0, 0, 1]]])
    none = torch.zeros(1, dtype=torch.int64)
    batch = Batch(
        rgb, rgb[:, :1], rgb[:, :1] > 0, camera, torch.eye(4)[None], none, none, torch.ones(1)
    )
    points = torch.tensor([[0.0, -0.03, 0], [0, 0.03, 0]])  # rows 169 and 175
    pose = torch.eye(4)
    pose[2, 3] = 1
    assert measure_objectness(objectness, batch, pose, points) == found


def test_a_track_has_no_conformal_sets() -> None:
    """Their guarantee is of the filter that was calibrated, and a track's is another."""
    toy, estimator = make_toy()
    sets = Conformal((), ((1.0,) * 30,), "probability")
    toy.calibration = Calibration(
        ("score",), (-5.0,), (2.0,), Logistic((3.0,), 0.0), Logistic((3.0,), 0.0),
        {"right": 20, "wrong": 0, "absent": 20}, "toy", {}, conformal=sets,
    )  # fmt: skip
    toy.truth = walk_pose(1)[0]
    assert estimator.predict(RGB, DEPTH, K).conformal is sets
    tracker = posefilter.Tracker(estimator)
    for _ in range(2):
        result = tracker.update(RGB, DEPTH, K)
        with pytest.raises(UserError, match=r"no conformal sets .* not of a track"):
            result.conformal_set(0.9)


def test_a_probability_of_another_tolerance_is_lowered_as_the_presence_was() -> None:
    rng = np.random.default_rng(0)
    there = rng.random(400) < 0.5
    values = np.where(there, -3.0, -9.0)[:, None] + rng.normal(size=(400, 1))
    off = [np.where(there, size * rng.random(400), np.nan) for size in (0.02, 1.0, 0.12, 0.1)]
    errors = PoseErrors(*off)
    toy, estimator = make_toy()
    toy.calibration = fit_calibration(
        Frames(("score",), values, there, RIGHT.accepts(errors), errors=errors), "toy"
    )
    toy.truth = walk_pose(1)[0]
    result = posefilter.Tracker(estimator).update(RGB, DEPTH, K)
    tolerance = PoseTolerance(translation_mm=10)
    single = posefilter.Result.probability_within(result, tolerance)
    assert result.presence is not None
    assert 0 < single < 0.9 * result.presence
    assert result.probability_within(tolerance) == pytest.approx(single)
    doubted = dataclasses.replace(result, presence=result.presence / 2)
    assert doubted.probability_within(tolerance) == pytest.approx(single / 2)


def test_why_a_lost_object_has_no_probability_is_told() -> None:
    """Where others are tracked, too, it is not probed for in every frame."""
    toys = [make_toy() for _ in range(2)]
    for toy, _ in toys:
        toy.calibration = Calibration(
            ("score",), (-5.0,), (2.0,), Logistic((3.0,), 0.0), Logistic((3.0,), 0.0),
            {"right": 20, "wrong": 0, "absent": 20}, "toy", {},
        )  # fmt: skip
    tracker = posefilter.Tracker([estimator for _, estimator in toys])
    frames = [*[RGB] * 4, BLACK]
    notes = [tracker.update_all(rgb, DEPTH, K)[1].calibration_note for rgb in frames]
    rest = "the object is lost, and was not probed for in this frame"
    assert notes == ["", "", rest, "", "the frame shows nothing"]


def test_a_tracks_belief_is_calibrated_where_it_was_measured() -> None:
    toy, estimator = make_toy()
    toy.calibration = Calibration(
        ("score",), (-5.0,), (2.0,), Logistic((3.0,), 0.0), Logistic((3.0,), 0.0),
        {"right": 20, "wrong": 0, "absent": 20}, "toy", {}, belief_scale=BeliefScale(-1.0, 0.0),
    )  # fmt: skip
    tracker, pose = posefilter.Tracker(estimator), walk_pose(1)[0]
    seen, hidden = range(8), range(8, 14)
    for number in (*seen, *hidden):
        toy.truth = pose if number in seen else None
        result = tracker.update(RGB, DEPTH, K)
        state = tracker.tracks[0].state
        assert state is not None
        assert result.particles == state.belief.state.shape[1]
        assert result.belief_calibrated == (number in seen)
        if number not in seen:
            continue
        # the particles that the next frame starts from are not touched, and are e times as wide
        particles = dataclasses.replace(
            result.belief,
            samples=state.belief.state[0].double().numpy(),
            weights=state.belief.log_weights[0].double().softmax(0).numpy(),
            draws=0,
        )
        widths = [
            np.sqrt(np.trace(one.covariance_about(result.pose)[:3, :3]))
            for one in (result.belief, particles)
        ]
        # e^-1 sqrt(5 / 3) = 0.47, a track's widening of 1.3, and the prior
        assert 0.35 < widths[0] / widths[1] < 0.75


def test_a_tracks_draws_lie_about_the_smoothed_pose() -> None:
    toy, estimator = make_toy()
    toy.calibration = Calibration(
        ("score",), (-5.0,), (2.0,), Logistic((3.0,), 0.0), Logistic((3.0,), 0.0),
        {"right": 20, "wrong": 0, "absent": 20}, "toy", {}, belief_scale=BeliefScale(-2.0, 0.0),
    )  # fmt: skip
    tracker = posefilter.Tracker(estimator, TrackerSettings(smoothing_noise=0.02))
    toy.truth = still = walk_pose(1)[0]
    for _ in range(6):
        tracker.update(RGB, DEPTH, K)
    toy.truth = SPACE.move(still, torch.tensor([0.008, 0, 0, 0, 0, 0]))
    result = tracker.update(RGB, DEPTH, K)
    assert result.status == "tracked"
    middle = np.median(result.belief.samples[: result.belief.draws], axis=0)
    behind = np.linalg.norm(result.pose[:3, 3] - toy.truth[:3, 3].double().numpy())
    assert behind > 0.004
    assert np.linalg.norm(middle[:3, 3] - result.pose[:3, 3]) < 0.25 * behind


def test_a_tracks_verdict_goes_by_the_costs_and_the_tolerance_of_its_estimator() -> None:
    toy, _ = make_toy()
    toy.calibration = Calibration(
        ("score",), (-5.0,), (2.0,), Logistic((3.0,), 0.0), Logistic((3.0,), 0.0),
        {"right": 20, "wrong": 20, "absent": 20}, "toy", {},
        errors=tabulate_errors(np.linspace(-1, 1, 40)[:, None], np.ones((40, 4))),
    )  # fmt: skip
    toy.truth = walk_pose(1)[0]
    careful, loose = posefilter.Costs(false_alarm=1e9), posefilter.PoseTolerance(add_s=2.0)
    strict = posefilter.PoseTolerance(add_s=0.5)  # which no frame of the calibration keeps
    usual = Estimator([toy], "cpu")
    others = (
        Estimator([toy], "cpu", costs=careful),
        Estimator([toy], "cpu", pose_tolerance=loose),
        Estimator([toy], "cpu", pose_tolerance=strict),
    )
    tracker = posefilter.Tracker([usual, *others])
    for _ in range(2):
        results = tracker.update(RGB, DEPTH, K)
        assert [one.verdict for one in results] == ["found", "unsure", "found", "unsure"]
        assert results[1].costs == careful
        assert [one.pose_tolerance for one in results] == [None, None, loose, strict]
    assert results[0].decide(posefilter.Costs()) == "found"
    assert results[0].decide(posefilter.Costs(), prior=1e-4) == "absent"


def test_in_doubt_the_network_sees_the_whole_image() -> None:
    toy, estimator = make_toy()
    tracker, sizes = (
        posefilter.Tracker(estimator, TrackerSettings(window_side=64, whole_image_every=0)),
        [],
    )
    toy.truth = walk_pose(1)[0]
    tracker.update(RGB, DEPTH, K)
    for depth in (DEPTH, NONE, DEPTH, DEPTH):
        toy.encoded.clear()
        tracker.update(RGB, depth, K)
        sizes.append(max(toy.encoded, default=None))
    assert max(*sizes[0], *sizes[3]) <= 64
    assert sizes[1:3] == [None, (120, 160)]


def test_wrong_inputs_are_doubted_beyond_the_first_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    toy, estimator = make_toy()
    scales = [1.25]
    measured: list[float] = []

    def measure(*_: Any) -> ScaleRatio:
        measured.append(scales[0])
        return ScaleRatio(*torch.tensor([[scales[0]], [20.0], [0.9]]))

    monkeypatch.setattr(toy, "measure_scale_ratio", measure)
    tracker = posefilter.Tracker(estimator, TrackerSettings(window_side=64))
    toy.truth = walk_pose(1)[0]
    results = [tracker.update(RGB, DEPTH, K) for _ in range(9)]
    assert all(one.wrong_size and one.scale_ratio == 1.25 for one in results)
    assert len(measured) == 3  # at first, and in frames with the whole image
    scales[0] = math.nan  # what is not known there is what was known
    assert all(tracker.update(RGB, DEPTH, K).wrong_size for _ in range(4))
    scales[0] = 1.0
    assert not [tracker.update(RGB, DEPTH, K) for _ in range(4)][-1].wrong_size
    count = len(measured)
    assert [tracker.update(RGB, DEPTH, K).scale_ratio for _ in range(5)] == [1.0] * 5
    assert len(measured) == count  # not where nothing is wrong
    scales[0], toy.truth = 0.7, None
    lost = [tracker.update(RGB, DEPTH, K) for _ in range(6)][-1]
    toy.truth = walk_pose(1)[0]
    found = [tracker.update(RGB, DEPTH, K) for _ in range(4)]
    assert (lost.status, found[-1].status) == ("lost", "tracked")
    assert found[-1].scale_ratio == pytest.approx(0.7)
    tracker.reset()
    assert tracker.tracks[0].scale_ratio is None
    scales[0] = math.nan  # of an object that is far away at first, or half in the frame
    assert all(math.isnan(tracker.update(RGB, DEPTH, K).scale_ratio) for _ in range(5))
    scales[0] = 1.25
    assert [tracker.update(RGB, DEPTH, K) for _ in range(4)][-1].wrong_size


def test_later_frames_may_be_covered_and_cameras_be_of_any_kind() -> None:
    toy, estimator = make_toy()
    tracker = posefilter.Tracker(estimator, seed=2**64)
    toy.truth = walk_pose(1)[0]
    tracker.update(RGB, DEPTH, K)
    for noise in (0.03, 65.535):  # of a hand on the sensor, or saturated
        covered = NONE.copy()
        covered[16, 32] = noise
        result = tracker.update(RGB, covered, K)
        assert "1 of 19200 pixels have depth" in result.blank
    with pytest.raises(UserError, match="is it in meters"):
        tracker.update(RGB, 1000 * DEPTH, K)
    for camera in (torch.tensor(K, requires_grad=True), torch.tensor(K).bfloat16(), K.tolist()):
        assert tracker.update(RGB, DEPTH, camera).is_tracked
    with pytest.raises(UserError, match="one size"):
        tracker.update(RGB, DEPTH, [[1.0, 0.0], [0.0, 1.0, 0.0]])


def test_a_frame_of_whose_cells_none_has_depth_is_passed_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No pose can be proposed there, though not every pixel is unknown."""
    toy, estimator = make_toy()
    toy.truth = walk_pose(1)[0]
    tracker = posefilter.Tracker(estimator, TrackerSettings(whole_image_every=1))
    propose = toy.propose_poses

    def propose_poses(encoding: Any, particles: int, generator: torch.Generator) -> torch.Tensor:
        require_depth(measure_cells(depth, torch.from_numpy(K)[None].float()).valid)
        return propose(encoding, particles, generator)

    monkeypatch.setattr(toy, "propose_poses", propose_poses)
    corners = NONE.copy()
    corners[::8, ::8] = DEPTH[::8, ::8]
    for z, covered in ((DEPTH, False), (corners, True), (DEPTH, False)):
        depth, before = torch.from_numpy(z)[None, None], len(toy.encoded)
        result = tracker.update(RGB, z, K)
        assert not result.blank
        assert result.is_tracked
        assert (len(toy.encoded) == before) == covered


def test_masked_depth_is_unknown_in_every_frame() -> None:
    tracker = posefilter.Tracker(make_toy()[1])
    masked = np.ma.MaskedArray(DEPTH, mask=DEPTH < 0.7)
    depths = [tracker.check(RGB, masked, K).depth for _ in range(2)]
    assert [np.count_nonzero(z) for z in depths] == [np.count_nonzero(DEPTH >= 0.7)] * 2


@pytest.mark.parametrize("patience", [1, 3])
def test_a_track_loss_detector_counts_frames_in_a_row(patience: int) -> None:
    detector = TrackLossDetector(
        TrackerSettings(patience=patience, lost_below=0.2, found_above=0.6)
    )
    assert [detector.judge(p)[1] for p in (0.1, 0.5, 0.7)] == ["lost", "lost", "started"]
    for _ in range(3):  # what is between the bounds, or good, starts the count anew
        assert [detector.judge(0.1)[1] for _ in range(patience - 1)] == ["tracked"] * (patience - 1)
        assert detector.judge(0.3) == (True, "tracked")
    assert [detector.judge(0.1)[1] for _ in range(patience)][-1] == "lost"
    assert [detector.judge(p) for p in (0.5, 0.7)] == [(False, "lost"), (True, "recovered")]


def test_one_bad_frame_is_no_loss() -> None:
    """The belief is moved on without a measurement; a frame without depth is such a frame."""
    toy, estimator = make_toy()
    tracker = posefilter.Tracker(estimator)
    toy.truth = pose = walk_pose(1)[0]
    for rgb, depth in ((RGB, DEPTH), (RGB, DEPTH), (RGB, NONE), (BLACK, DEPTH), (RGB, DEPTH)):
        result = tracker.update(rgb, depth, K)
        assert result.is_tracked == (rgb is not BLACK)
        assert off(result, pose) < 0.01
        blank = rgb is BLACK or depth is NONE
        assert (result.objectness == 0) == blank
        assert (result.verdict == "unsure") == blank
    assert result.status == "recovered"  # two of them are a loss


def test_the_first_frame_that_shows_something_is_the_first() -> None:
    toy, estimator = make_toy()
    tracker = posefilter.Tracker(estimator)
    toy.truth = pose = walk_pose(1)[0]
    for rgb, depth, told in ((RGB, NONE, "have depth"), (BLACK, DEPTH, "is black")):
        result = tracker.update(rgb, depth, K)
        assert result.status == "lost"
        assert result.verdict == "unsure"
        assert told in result.warnings[0]
    result = tracker.update(RGB, DEPTH, K)
    assert result.status == "started"
    assert off(result, pose) < 0.01
    first = posefilter.Tracker(estimator).update(RGB, DEPTH, K)
    assert np.array_equal(result.pose, first.pose)


def test_what_was_never_there_is_never_tracked() -> None:
    _, estimator = make_toy()
    tracker = posefilter.Tracker(estimator)
    results = [tracker.update(RGB, DEPTH, K) for _ in range(8)]
    assert {one.status for one in results} == {"lost"}


def test_smoothing_damps_jitter_and_follows_a_jump() -> None:
    deviations, last = [], []
    for noise in (0.0, 0.01):
        toy, estimator = make_toy()
        tracker = posefilter.Tracker(estimator, TrackerSettings(smoothing_noise=noise))
        toy.truth = truth = walk_pose(1)[0]
        still = [tracker.update(RGB, DEPTH, K).pose[:3, 3] for _ in range(20)]
        deviations.append(np.std(np.diff(still[5:], axis=0)))
        toy.truth = SPACE.move(truth, torch.tensor([0.03, 0, 0, 0, 0, 0]))
        last.append(off([tracker.update(RGB, DEPTH, K) for _ in range(3)][-1], toy.truth))
    assert deviations[1] < 0.5 * deviations[0]
    assert max(last) < 0.01


def test_several_objects_give_a_list_and_the_seed_decides() -> None:
    toy, estimator = make_toy()
    toy.truth = walk_pose(1)[0]
    both = posefilter.Tracker([estimator, estimator], seed=3)
    alone = posefilter.Tracker(estimator, seed=3)
    assert both.objects == ("toy", "toy")
    for _ in range(3):
        pair, one = both.update(RGB, DEPTH, K), alone.update(RGB, DEPTH, K)
        assert np.array_equal(pair[0].pose, one.pose)
    alone.reset()
    again = [alone.update(RGB, DEPTH, K) for _ in range(3)][-1]
    assert np.array_equal(again.pose, one.pose)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"patience": 0}, "patience=0 must be a whole number, at least 1"),
        ({"search_above": 1.5}, "search_above=1.5 must be a number, at least 0, at most 1"),
        ({"lost_below": 0.9}, "lost_below=0.9 is above found_above=0.5"),
        ({"window_scale": 0.5}, "window_scale=0.5 must be a number, at least 1"),
        ({"kld_quantile": 1.0}, "kld_quantile=1.0 must be a number, above 0, at most 0.9"),
        ({"elsewhere_penalty": -1.0}, "elsewhere_penalty=-1.0 must be a number, at least 0"),
        ({"jump_penalty": math.nan}, "jump_penalty=nan must be a number, at least 0, at most"),
        ({"lost_below": "0.2"}, "lost_below='0.2' must be a number, at least 0, at most 1"),
        ({"follow": None}, "follow=None must be a posefilter.tracking.settings.FilterSettings"),
        ({"motion": 5.0}, "motion=5.0 must be a posefilter.tracking.motion.ConstantVelocity"),
    ],
)
def test_impossible_settings_are_refused(wrong: dict[str, Any], told: str) -> None:
    with pytest.raises(UserError, match=told):
        TrackerSettings(**wrong)


def test_impossible_filters_and_methods_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    follow = TrackerSettings().follow
    with pytest.raises(UserError, match="max_particles=5 is below min_particles=10"):
        dataclasses.replace(follow, min_particles=10, max_particles=5)
    with pytest.raises(UserError, match="noise levels fall"):
        FilterSettings(10, 20, 0, 2, 0.001, 0.004, 64)
    with pytest.raises(
        UserError, match="initial_sigma=None must be a number, above 0, at most 100"
    ):
        dataclasses.replace(follow, initial_sigma=None)
    with pytest.raises(UserError, match="velocity_gain=a: must lie between 0 and 1"):
        ConstantVelocity(velocity_gain="a")  # type: ignore[arg-type]
    toy, estimator = make_toy()
    monkeypatch.setattr(type(toy), "provides", ("pose", "pose_space", "score_poses", "objectness"))
    toy.__dict__.pop("capabilities", None)
    with pytest.raises(UserError, match=r"Toy provides no propose_poses; .*model/proposals=dense"):
        posefilter.Tracker(estimator)


class PlantedRotations(TextureRotations):
    """Say at every call that the object is a quarter turn about its axis from the estimate."""

    TURN = SPACE.move(torch.eye(4), torch.tensor([0, 0, 0, 0, 0, np.pi / 2]))

    def __init__(self, few: bool) -> None:
        super().__init__()
        self.few, self.calls, self.nearby = few, 0, 0

    def __call__(self, belief, encoding, method, generator):  # type: ignore[no-untyped-def]
        self.calls += 1
        scattered = belief.poses.flip(1)  # which a track must not take over
        return belief._replace(best=belief.best @ self.TURN, poses=scattered)

    def rotate_nearby(self, best, encoding, method):  # type: ignore[no-untyped-def]
        self.nearby += 1
        self.calls += not self.few
        return None if self.few else best @ self.TURN


@pytest.mark.parametrize("few", [True, False])
def test_all_particles_are_turned_with_the_estimate(few: bool) -> None:
    poses = random_rotation(6, generator=torch.Generator().manual_seed(0))
    moved = torch.eye(4).repeat(6, 1, 1)
    moved[:, :3, :3] = poses
    belief = BeliefBatch(moved[None], torch.zeros(1, 6), moved[None, 2], torch.zeros(1))
    turned = RotateTogether(PlantedRotations(few))(belief, None, None, torch.Generator())
    torch.testing.assert_close(turned.poses, belief.poses @ PlantedRotations.TURN)
    torch.testing.assert_close(turned.best, turned.poses[:, 2])
    assert turned.score is belief.score


@pytest.mark.parametrize(("every", "due"), [(0, []), (4, [1, 5, 9]), (8, [2, 10])])
def test_the_print_decides_every_so_many_frames(every: int, due: list[int]) -> None:
    toy, estimator = make_toy()
    texture = PlantedRotations(few=True)
    toy.filter.refine = Compose([texture])
    tracker = posefilter.Tracker(estimator, TrackerSettings(texture_every=every))
    asked = []
    for number, pose in enumerate(walk_pose(12)):
        toy.truth, before = pose, texture.calls
        assert tracker.update(RGB, DEPTH, K).status == ("tracked" if number else "started")
        if number and texture.calls > before:
            asked.append(number)
        texture.TURN = torch.eye(4)  # the first frame is a single image, and says nothing here
    assert asked == due


@pytest.mark.parametrize(("every", "due"), [(4, [0, 1, 9]), (0, [0, 2])])
def test_the_textures_margin_is_measured_now_and_then_and_kept(
    every: int, due: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    toy, estimator = make_toy()
    toy.calibration = Calibration(
        ("score", "rotation_margin"), (-5.0, 4.5), (2.0, 9.0), Logistic((3.0, 0.0), 0.0),
        Logistic((0.0, 4.0), 0.0), {"right": 20, "wrong": 0, "absent": 20}, "toy", {},
    )  # fmt: skip
    collect, measured, now = toy.collect_features, [], [0]

    def collect_with_margin(trace: Any, batch: Batch, margin: Any = None) -> dict[str, Any]:
        if margin is None:
            measured.append(now[0])
            margin = torch.full((1,), float(now[0]))
        return collect(trace, batch) | {"rotation_margin": margin}

    monkeypatch.setattr(toy, "collect_features", collect_with_margin)
    settings = TrackerSettings(texture_every=every, whole_image_every=4)
    tracker, probabilities = posefilter.Tracker(estimator, settings), []
    for number, pose in enumerate(walk_pose(12)):
        now[0], toy.truth = number, pose
        probabilities.append(tracker.update(RGB, DEPTH, K).probability)
    assert measured == due
    risen = np.flatnonzero(np.diff(np.array(probabilities, float)) > 0.03) + 1
    assert risen.tolist() == due[1:]
    toy.truth = None
    tracker.update(RGB, DEPTH, K)
    assert [tracker.update(RGB, DEPTH, K).status for _ in range(2)][-1] == "lost"
    lost, now[0] = len(measured), 100
    for _ in range(3):
        tracker.update(RGB, DEPTH, K)
    assert len(measured) - lost <= 1  # at most where a search ends
    toy.truth = walk_pose(1)[0]
    assert tracker.update(RGB, DEPTH, K).status == "recovered"
    assert measured[-1] == 100  # what a search finds is not judged by an earlier margin


def test_after_a_loss_the_print_decides_among_all_turns() -> None:
    """The frame before tells nothing of them, so that those nearby are not asked for."""
    toy, estimator = make_toy()
    texture = PlantedRotations(few=False)
    toy.filter.refine = Compose([texture])
    tracker = posefilter.Tracker(estimator, TrackerSettings(texture_every=0))
    pose, recovered = walk_pose(1)[0], []
    for number in range(12):
        toy.truth = None if 2 <= number < 6 else pose
        texture.TURN = PlantedRotations.TURN if number >= 6 else torch.eye(4)
        result = tracker.update(RGB, DEPTH, K)
        if result.status == "recovered":
            recovered.append(number)
            assert off(result, pose @ PlantedRotations.TURN) < 0.01
    assert len(recovered) == 1
    assert texture.nearby == 0


def test_warnings_are_of_the_photograph_whatever_is_looked_at() -> None:
    """A window has another principal point, and other depth."""
    toy, estimator = make_toy()
    tracker = posefilter.Tracker(estimator, TrackerSettings(whole_image_every=3, window_side=64))
    aside, middle = K.copy(), K.copy()
    aside[0, 2] = 30.0
    pose = walk_pose(1)[0]
    for matrix, told in ((middle, False), (aside, True)):
        tracker.reset()
        toy.truth = pose
        toy.encoded.clear()
        for _ in range(7):
            warnings = tracker.update(RGB, DEPTH, matrix).warnings
            assert any("principal point is far" in one for one in warnings) == told
            assert len(warnings) == told
        assert {(120, 160)} < set(toy.encoded)  # some saw a window
