"""What metrics make of what lies exactly at an edge, a threshold or an end."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.models.toy import scenes, square

from posefilter.confidence.tolerance import measure_pose_errors
from posefilter.errors import UserError
from posefilter.geometry.lookup import is_off_frame
from posefilter.geometry.pose import make_pose, origin_of, pose_about, rotation_of, transform
from posefilter.geometry.rotation import exp_so3, random_rotation
from posefilter.geometry.spaces import PoseSpace
from posefilter.geometry.symmetries import densify, is_ball
from posefilter.meshes.symmetries import rotation_about, symmetry_group
from posefilter.metrics.bop import (
    MSPD_THRESHOLDS,
    MSSD_THRESHOLDS,
    BopErrors,
    average_recall,
    mssd,
)
from posefilter.metrics.bop_results import HEADER, PoseRow, read_poses_csv, write_poses_csv
from posefilter.metrics.collect import BeliefQuality, PoseErrors
from posefilter.metrics.confidence import calibration_error, error_at_coverage, list_bins
from posefilter.metrics.diagnostics import (
    auroc,
    distinct,
    first_axis_share,
    near_edge,
    offset_cosine,
    pairwise_cosine,
    r2_score,
)
from posefilter.metrics.errors import add, add_up_to_symmetry
from posefilter.metrics.image_errors import parse_row, read_errors, summarize_images
from posefilter.metrics.parts import PartIoU, label_pixels
from posefilter.metrics.results import compute_checkpoint_score, flatten
from posefilter.metrics.scores import auc, median, overall, recall
from posefilter.metrics.tracks import measure_jitter
from posefilter.metrics.vsd import TAUS
from posefilter.types import BeliefBatch

MODEL = square()


def pixels(*places: tuple[float, float]) -> torch.Tensor:
    return torch.tensor(places)[None]


def test_the_frame_ends_half_a_pixel_beyond_the_outermost_centers() -> None:
    inside = pixels((-0.5, -0.5), (9.5, 5.5), (-0.5, 5.5), (9.5, -0.5), (4.0, 3.0))
    assert not is_off_frame(inside, 10, 6).any()
    outside = pixels((-0.6, 3.0), (9.6, 3.0), (4.0, -0.6), (4.0, 5.6))
    assert is_off_frame(outside, 10, 6).all()


def test_near_an_edge_is_within_a_twentieth_of_the_frame() -> None:
    """The outer edges of 100 pixels are at -0.5 and 99.5, so five pixels end at 4.5 and 94.5."""
    for near, far in ((4.4, 4.6), (94.6, 94.4)):
        for place in ((near, 50.0), (50.0, near)):
            assert near_edge(pixels(place), 100, 100)[0].item() == 1
        for place in ((far, 50.0), (50.0, far)):
            assert near_edge(pixels(place), 100, 100)[0].item() == 0
        assert near_edge(pixels((near, near)), 100, 100)[1].item() == 1
        assert near_edge(pixels((near, far)), 100, 100)[1].item() == 0
    assert near_edge(pixels((8.0, 50.0)), 100, 100, share=0.1)[0].item() == 1


def test_a_particle_that_hardly_moves_has_no_direction() -> None:
    """One thousandth of a pixel is no move; the cosine is of the two that do move."""
    moves = torch.tensor([[[1.0, 0.0], [0.0, 0.002], [-9e-4, 0.0]]])
    assert pairwise_cosine(moves).item() == pytest.approx(0.0, abs=1e-6)
    assert math.isnan(pairwise_cosine(moves[:, [0, 2]]).item())
    three = torch.tensor([[[2.0, 0.0], [0.5, 0.0], [0.0, 3.0]]])
    assert pairwise_cosine(three).item() == pytest.approx(1 / 3)


def test_the_offset_cosine_counts_beyond_one_pixel() -> None:
    true = torch.tensor([[1.0, 0.0], [0.0, 1.5]])
    assert offset_cosine(torch.tensor([[-1.0, 0.0], [0.0, 0.2]]), true).item() == pytest.approx(1.0)
    assert math.isnan(offset_cosine(true[:1], true[:1]).item())


def test_areas_and_shares_of_too_little_are_undefined() -> None:
    yes, no = torch.tensor([True, True]), torch.tensor([False, False])
    score = torch.tensor([0.1, 0.2])
    assert math.isnan(auroc(score, yes))
    assert math.isnan(auroc(score, no))
    assert auroc(score, torch.tensor([False, True])) == 1
    same = torch.ones(4, 2)
    assert math.isnan(r2_score(torch.zeros(4, 2), same))
    assert first_axis_share(torch.tensor([[[0.0, 0.0], [0.01, 0.0]]])).item() == pytest.approx(1.0)
    assert first_axis_share(torch.tensor([[[0.0, 0.0], [1e-4, 0.0]]])).isnan().all()


def test_positions_count_as_one_within_a_tenth_of_a_pixel() -> None:
    state = torch.tensor([[[1.0, 1.0], [1.04, 1.0], [1.1, 1.0], [1.0, 1.2]]])
    assert distinct(state).tolist() == [0.75]
    assert distinct(state, cell_px=1.0).tolist() == [0.25]


def test_jitter_is_the_length_of_steps_in_all_directions() -> None:
    """One step of 3 and 4 mm along x and y is 5 mm, then none: the root mean square of two."""
    space = PoseSpace((0.0, 0.0, 0.0), 0.1)
    twist = torch.tensor([0.003, 0.004, 0.0, *(math.radians(x) for x in (6.0, 0.0, 8.0))]).double()
    error = torch.stack([torch.zeros(6).double(), twist, twist])
    truth = torch.eye(4).double().expand(3, 4, 4)
    shift, turn = measure_jitter(space.move(truth, error), truth, torch.zeros(3).double())
    assert shift == pytest.approx(5 / math.sqrt(2))
    assert turn == pytest.approx(10 / math.sqrt(2), rel=1e-6)


def test_thresholds_of_the_challenge() -> None:
    assert pytest.approx([k / 20 for k in range(1, 11)]) == MSSD_THRESHOLDS
    assert pytest.approx([k / 20 for k in range(1, 11)]) == TAUS
    assert MSPD_THRESHOLDS == (5, 10, 15, 20, 25, 30, 35, 40, 45, 50)
    # an error is right below a threshold, not at it
    one = torch.ones(1).double()
    assert average_recall(50 * one, MSPD_THRESHOLDS, one) == 0
    assert average_recall(45 * one, MSPD_THRESHOLDS, one) == pytest.approx(10)


def test_errors_of_a_width_are_those_of_640_and_medians_of_two_the_middle() -> None:
    """A shift of 1 cm at 1 m and 100 px of focal length is 1 px, and 4 px in an image 4 times as
    wide."""
    K = torch.tensor([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]]).expand(2, 3, 3)
    truth = make_pose(torch.eye(3), torch.tensor([[0.0, 0.0, 1.0]] * 2))
    guess = make_pose(torch.eye(3), torch.tensor([[0.01, 0.0, 1.0], [0.03, 0.0, 1.0]]))
    metric = BopErrors([MODEL])
    metric.update(guess, truth, K, 160)
    found = metric.compute()
    assert found["mspd"]["median_px"] == pytest.approx(8, rel=1e-5)
    assert found["mssd"]["median_mm"] == pytest.approx(20, rel=1e-5)
    two = BopErrors([MODEL, MODEL._replace(diameter=0.05)])
    two.update(guess, truth, K, 160, torch.tensor([0, 1]))
    # 0.01 of 0.283 m: all ten; 0.03 of 0.05 m is 0.6: none
    assert two.compute()["mssd"]["ar"] == pytest.approx(50)


def test_a_symmetry_of_few_digits_is_filled_in_about_its_axis() -> None:
    """A checkpoint keeps turns in 32 bits, where the axis is only nearly what a turn leaves."""
    axis, point = np.array([0.6, 0.0, 0.8]), np.array([0.2, -0.1, 0.3])
    coarse = torch.from_numpy(symmetry_group(continuous=[(axis, point)], steps=36)).float().double()
    fine = densify(coarse)
    on_axis = torch.from_numpy(point + 0.1 * axis)[None]
    assert float((transform(fine, on_axis) - on_axis).norm(dim=-1).max()) < 1e-5
    assert len(densify(coarse, math.radians(5.1))) == 36 * 2
    # turns of 15 degrees are few, but all that there are
    few = torch.from_numpy(symmetry_group(continuous=[(axis, point)], steps=24))
    assert densify(few) is few


def make_ball() -> tuple[torch.Tensor, torch.Tensor]:
    """Return a ball's symmetries, about a point that is not the origin, and points of it."""
    lines = [
        (np.array([1.0, 0, 0]), np.array([0.3, 0.05, 0.02])),
        (np.array([0.0, 0.8, 0.6]), np.array([0.1, 0.13, 0.08])),
    ]
    symmetries = torch.from_numpy(symmetry_group(continuous=lines, steps=36))
    center = torch.tensor([0.1, 0.05, 0.02]).double()
    points = center + 0.035 * torch.nn.functional.normalize(torch.randn(200, 3).double(), dim=1)
    return symmetries, points


def test_a_ball_may_be_turned_anyhow() -> None:
    symmetries, points = make_ball()
    center = torch.tensor([0.1, 0.05, 0.02]).double()
    assert is_ball(symmetries)
    assert densify(symmetries) is symmetries
    torch.testing.assert_close(transform(symmetries, center[None])[:, 0], center.expand(1296, 3))
    anyhow = random_rotation(300).double()
    near = anyhow[:, None].mT @ rotation_of(symmetries)
    cosine = (near.diagonal(dim1=-2, dim2=-1).sum(-1).amax(1) - 1) / 2
    assert math.degrees(float(cosine.min().acos())) < 20  # of the nearest that is known
    truth = make_pose(anyhow[:150], torch.tensor([0.0, 0.0, 1.0]).double())
    poses = pose_about(anyhow[150:], origin_of(truth, center), center)
    poses[..., 0, 3] += 0.003
    off = torch.full((150,), 0.003).double()
    torch.testing.assert_close(add_up_to_symmetry(poses, truth, points, symmetries), off)
    torch.testing.assert_close(mssd(poses, truth, symmetries, points), off)
    model = MODEL._replace(symmetries=symmetries, points=points, center=center)
    errors = measure_pose_errors(poses, truth, model)
    torch.testing.assert_close(errors.translation, off)
    assert float(errors.rotation.max()) < 1e-3


@pytest.mark.parametrize("flip", [False, True])
def test_what_turns_about_one_axis_is_no_ball(flip: bool) -> None:
    half = [rotation_about(np.array([1.0, 0, 0]), np.pi, np.zeros(3))] if flip else []
    turns = symmetry_group(half, [(np.array([0, 0, 1.0]), np.zeros(3))], steps=144)
    assert not is_ball(torch.from_numpy(turns))


def write_row(path: Path, **changes: str) -> Path:
    cells = {"scene_id": "1", "im_id": "2", "obj_id": "3", "score": "0.5", "time": "-1"}
    cells |= {"R": "1 0 0 0 1 0 0 0 1", "t": "0 0 800"} | changes
    path.write_text(",".join(HEADER) + "\n" + ",".join(cells[name] for name in HEADER) + "\n")
    return path


def test_poses_must_be_finite_and_scores_need_not(tmp_path: Path) -> None:
    file = tmp_path / "poses.csv"
    row = read_poses_csv(write_row(file, score="inf"))[0]
    assert (row.scene_id, row.im_id, row.obj_id, row.score, row.seconds) == (1, 2, 3, math.inf, -1)
    assert row.camera_from_native[2, 3] == 0.8
    for name, cell in (("t", "0 0 nan"), ("t", "inf 0 1"), ("R", "nan 0 0 0 1 0 0 0 1")):
        with pytest.raises(UserError, match=f"{name} is not finite"):
            read_poses_csv(write_row(file, **{name: cell}))


def test_a_rotation_may_be_rounded_but_not_wrong(tmp_path: Path) -> None:
    file = tmp_path / "poses.csv"
    assert read_poses_csv(write_row(file, R="1.004 0 0 0 1 0 0 0 1"))
    for R in ("1.006 0 0 0 1 0 0 0 1", "1 0 0 0 1 0 0 0 -1", "-1 0 0 0 -1 0 0 0 -1"):
        with pytest.raises(UserError, match="R is no rotation"):
            read_poses_csv(write_row(file, R=R))
    for name, cell, told in (
        ("R", "1 0 0", "R has 3 numbers, expected 9"),
        ("t", "1 2", "t has 2 numbers, expected 3"),
        ("score", "1 2", "score has 2 numbers, expected 1"),
        ("time", "x", "time holds something that is no number"),
        ("im_id", "1.5", "im_id is '1.5'"),
    ):
        with pytest.raises(UserError, match=f"line 2: {told}"):
            read_poses_csv(write_row(file, **{name: cell}))
    file.write_text("1,2,3\n")
    with pytest.raises(UserError, match="line 1: 3 columns, expected 7"):
        read_poses_csv(file)


def test_results_are_read_as_written_with_or_without_a_header(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = 0.1, -0.2, 1 / 3
    file = tmp_path / "poses.csv"
    write_poses_csv(file, [PoseRow(1, 2, 3, 0.25, pose, 0.5)] * 2)
    lines = file.read_text().splitlines()
    assert lines[0] == "scene_id,im_id,obj_id,score,R,t,time"
    assert lines[1].split(",")[3:5] == ["0.25", "1.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 1.0"]
    whole = read_poses_csv(file)
    assert len(whole) == 2
    np.testing.assert_array_equal(whole[0].camera_from_native, pose)
    upper = [lines[0].upper(), *lines[1:], "   "]
    for text in ("\n".join(lines[1:]), "\ufeff" + "\n\n".join(lines), "\n".join(upper)):
        file.write_text(text)
        again = read_poses_csv(file)
        assert len(again) == 2
        np.testing.assert_array_equal(again[1].camera_from_native, pose)


def test_the_highest_probability_is_kept_however_few_there_are() -> None:
    right = torch.tensor([True, False, False])
    probability = torch.tensor([0.9, 0.5, 0.1])
    assert error_at_coverage(probability, right, 0.1) == 0
    assert error_at_coverage(probability, right, 0.34) == 0
    assert error_at_coverage(probability, right, 0.67) == pytest.approx(0.5)
    assert error_at_coverage(probability, ~right, 0.1) == 1
    assert math.isnan(error_at_coverage(probability[:0], right[:0]))


def test_the_end_of_a_bin_belongs_to_the_next_and_one_to_the_last() -> None:
    probability = torch.tensor([0.5, 1.0, 0.0])
    right = torch.tensor([True, True, False])
    assert [(b["from"], b["to"]) for b in list_bins(probability, right, 2)] == [(0, 0.5), (0.5, 1)]
    assert [b["frames"] for b in list_bins(probability, right, 2)] == [1, 2]
    assert calibration_error(probability, right, 2) == pytest.approx(0.5 / 3)


def test_add_up_to_symmetry_is_the_least_of_all() -> None:
    quarter = torch.tensor([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    truth = torch.eye(4).expand(2, 4, 4)
    poses = torch.stack([quarter, torch.eye(4)])
    assert (add(poses, truth, MODEL.points)[0] > 0.05).item()
    found = add_up_to_symmetry(poses, truth, MODEL.points, torch.stack([torch.eye(4), quarter]))
    torch.testing.assert_close(found, torch.zeros(2), atol=1e-6, rtol=0)


def test_of_many_symmetries_add_is_still_the_least() -> None:
    draw = torch.Generator().manual_seed(0)
    points = 0.1 * torch.randn(700, 3, generator=draw, dtype=torch.float64)
    around = torch.eye(4, dtype=torch.float64).repeat(40, 1, 1)
    around[:, :3, :3] = exp_so3(
        torch.arange(40)[:, None] * torch.tensor([0, 0, math.tau / 40], dtype=torch.float64)
    )
    poses = torch.eye(4, dtype=torch.float64).repeat(20, 1, 1)
    poses[:, :3, :3] = exp_so3(2 * torch.randn(20, 3, generator=draw, dtype=torch.float64))
    truth = torch.eye(4, dtype=torch.float64).expand(20, 4, 4)
    every = add(poses[:, None], truth[:, None] @ around, points)
    found = add_up_to_symmetry(poses, truth, points, around)
    torch.testing.assert_close(found, every.amin(1), rtol=1e-3, atol=0)
    assert (every.amax(1) > 1.05 * found).all()


def test_only_objects_with_symmetries_are_also_measured_up_to_them() -> None:
    def turn(degrees: float) -> torch.Tensor:
        pose, angle = torch.eye(4), torch.tensor(degrees).deg2rad()
        pose[:2, :2] = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()]).view(2, 2)
        return pose

    around = MODEL._replace(symmetries=torch.stack([turn(a) for a in range(0, 360, 10)]))
    truth = torch.eye(4).expand(2, 4, 4)
    poses = torch.stack([turn(95.0), torch.full((4, 4), torch.nan)])  # between two of them; missed
    plain, symmetric = PoseErrors([MODEL]), PoseErrors([around])
    for metric in (plain, symmetric):
        metric.update(poses, truth)
    found = symmetric.compute()
    assert "add_up_to_symmetry" not in plain.compute()
    assert found["add"] == plain.compute()["add"]
    assert found["add_up_to_symmetry"]["auc"] > 49 > found["add"]["auc"]
    assert found["add_up_to_symmetry"]["recall_01d"] == 50


def test_older_tables_of_errors_have_fewer_columns(tmp_path: Path) -> None:
    row = dict.fromkeys(("scene_id", "im_id", "obj_id"), "1") | {"object": "box", "image": "a"}
    names = ("visibility", "add_mm", "add_s_mm", "diameter_mm", "particles_on_object", "score")
    row |= dict.fromkeys(names, "0.5") | {"seconds": "0.1"}
    old = parse_row(row)
    assert (old.obj_id, old.object, old.add_mm) == (1, "box", 0.5)
    assert all(math.isnan(x) for x in old[-5:])
    assert parse_row(row | {"presence": "0.25", "more": "x"}).presence == 0.25
    with pytest.raises(ValueError, match="column add_mm is missing"):
        parse_row({name: value for name, value in row.items() if name != "add_mm"})
    file = tmp_path / "errors.csv"
    file.write_text(",".join(row) + "\n" + ",".join(row.values()) + "\n")
    assert read_errors(file)[0][:-5] == old[:-5]
    # errors of 5 and 15 mm of an object of 100 mm
    rows = [old._replace(add_mm=x, add_s_mm=x / 5, diameter_mm=100.0) for x in (5.0, 15.0)]
    found = summarize_images(rows)
    assert found["add"]["recall_01d"] == 50
    assert found["add"]["median_mm"] == pytest.approx(10)
    assert found["add_s"]["median_mm"] == pytest.approx(2)


def test_scores_at_their_limits() -> None:
    errors = torch.tensor([0.02, 0.05], dtype=torch.float64)
    assert recall(errors, 0.02) == 0
    assert recall(errors, 0.021) == 50
    assert auc(errors, 0.05) == pytest.approx(100 * 0.5)  # half from 0 on; the other is no hit
    assert auc(errors, 0.2) == pytest.approx(100 * (0.02 * 0.5 + 0.03 + 0.15) / 0.2)
    assert median(torch.tensor([0.001, 0.002, 0.004, 0.1])) == pytest.approx(0.003)
    assert median(torch.tensor([0.004, 0.001, 0.002])) == pytest.approx(0.002)
    assert overall(None, 0.5, 0.25) == pytest.approx(37.5)
    assert overall(71.0, 0.5, 0.25) == 71


def test_the_score_of_a_detector_is_of_particles_and_box() -> None:
    pose = {"add": {"auc": 40.0}, "particles_on_object": 0.5, "iou": 0.7}
    assert compute_checkpoint_score(pose) == 40
    assert compute_checkpoint_score(pose | {"add": None}) == pytest.approx(60)
    assert compute_checkpoint_score({"add": {}, "particles_on_object": None, "iou": 0.5}) == 25
    assert flatten({"a": {"b": 1, "c": "x"}, "d": 2.5}) == {"a/b": 1.0, "d": 2.5}


def test_a_pose_that_is_not_finite_is_missed() -> None:
    truth = torch.eye(4).expand(3, 4, 4)
    guess = truth.clone()
    guess[1, 2, 3] = torch.inf
    guess[2] = torch.nan
    metric = PoseErrors([MODEL])
    metric.update(guess, truth)
    assert metric.compute()["missed"] == 2
    empty = PoseErrors([MODEL]).compute()
    assert (empty["instances"], empty["missed"]) == (0, 0)
    assert math.isnan(empty["add"]["auc"])


def belief_at(shifts: list[float], log_w: torch.Tensor) -> BeliefBatch:
    t = torch.tensor([[x, 0.0, 0.0] for x in shifts])
    poses = make_pose(torch.eye(3).expand(len(t), 3, 3), t)[None]
    return BeliefBatch(poses, log_w[None], poses[:, 0], log_w[None, 0])


def test_the_quality_of_a_belief_by_hand() -> None:
    """Mass within 0.1 diameters and within 2 cm; the object's own diameter counts."""
    log_w = torch.tensor([0.5, 0.3, 0.2]).log()
    belief = belief_at([0.0, 0.015, 0.025], log_w)
    large, small = BeliefQuality(MODEL), BeliefQuality(MODEL._replace(diameter=0.1))  # 28, 10 mm
    large.update(belief, torch.eye(4)[None])
    found = large.compute()
    assert found["mass_01d"] == pytest.approx(1.0)
    assert found["mass_2cm"] == pytest.approx(0.8)
    assert found["effective_particles"] == pytest.approx(1 / 0.38)
    mean = 0.3 * 0.015 + 0.2 * 0.025
    square_mean = 0.3 * 0.015**2 + 0.2 * 0.025**2
    assert found["spread_m"] == pytest.approx(math.sqrt(square_mean - mean**2), rel=1e-4)
    small.update(belief, torch.eye(4)[None])
    assert small.compute()["mass_01d"] == pytest.approx(0.5)
    assert BeliefQuality(MODEL).compute() == {}


def test_coverage_counts_ranks_up_to_its_level() -> None:
    """The truth lies as deep as the best particle, then outside all."""
    metric = BeliefQuality(MODEL)
    log_w = torch.full((4,), -math.log(4))
    belief = belief_at([0.0, 0.01, 0.02, 0.5], log_w)
    metric.update(belief, torch.eye(4)[None])
    inside = metric.compute()
    assert inside["rank"] <= 0.5
    assert (inside["distance_coverage_50"], inside["distance_coverage_90"]) == (100, 100)
    outside = torch.eye(4)[None].clone()
    outside[0, 0, 3] = 3.0
    metric.update(belief, outside)
    assert (metric.compute()["distance_coverage_50"], metric.compute()["distance_coverage_90"]) == (
        50,
        50,
    )


def test_a_point_belongs_to_a_part_within_a_tenth_of_the_diameter() -> None:
    """Of 0.1 m: up to 10 mm from the part's nearest point."""
    parts = {"a": torch.zeros(1, 3), "b": torch.tensor([[0.04, 0.0, 0.0]])}
    model = MODEL._replace(parts=parts, diameter=0.1)
    points = torch.tensor([[0.009, 0.0, 0.0], [0.011, 0.0, 0.0], [0.031, 0.0, 0.0], [0.0, 0.0, 1]])
    assert label_pixels(points, torch.eye(4), model).tolist() == [0, -1, 1, -1]


def test_every_visible_pixel_of_a_part_counts_where_there_are_few() -> None:
    """A column of pixels each on a part: at a pose that is a column off, all but two change."""
    batch = scenes(1)
    mask = torch.zeros_like(batch.mask)
    mask[0, 0, 20, 30:36] = True
    depth = torch.full_like(batch.depth, 0.6)
    step = 0.6 / 60.0  # [m] of a pixel
    at = torch.eye(4)[None].clone()
    at[0, :3, 3] = torch.tensor([(30 - 31.5) * step, (20 - 23.5) * step, 0.6])
    line = torch.arange(6.0)[:, None] * torch.tensor([step, 0.0, 0.0])
    parts = {"even": line[::2], "odd": line[1::2]}
    model = MODEL._replace(parts=parts, diameter=10 * step * 0.9, hull=line)
    batch = batch._replace(mask=mask, depth=depth, camera_from_object=at)
    metric = PartIoU(model)
    metric.update(at, batch)
    assert metric.compute()["mask_iou"] == pytest.approx(1.0)
    assert metric.counts[1].tolist() == [1, 1]
    moved = at.clone()
    moved[0, 0, 3] += step  # every pixel is now of the other part, the first of none
    metric.update(moved, batch)
    assert metric.compute()["mask_iou"] == pytest.approx(0.5)
    moved[0, 0, 3] += step  # two pixels are lost, of each part one of three
    metric.reset()
    metric.update(moved, batch)
    assert metric.compute()["by_part"]["even"]["mask_iou"] == pytest.approx(2 / 3)
    assert metric.compute()["by_part"]["odd"]["mask_iou"] == pytest.approx(2 / 3)
    # a part that is in no image has no share
    metric.reset()
    metric.update(at, batch._replace(mask=torch.zeros_like(mask)))
    assert math.isnan(metric.compute()["mask_iou"])


def test_the_last_bin_is_a_bin_of_its_own() -> None:
    """One that is right at 0.2 and one that is wrong at 0.9: both are off, and do not cancel."""
    probability, right = torch.tensor([0.2, 0.9]), torch.tensor([True, False])
    assert calibration_error(probability, right, 2) == pytest.approx((0.8 + 0.9) / 2)


def test_poses_in_meters_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "poses.csv"
    rows = ["1,1,1,0.5,1 0 0 0 1 0 0 0 1,0.1 0.0 0.7,-1"] * 3
    file.write_text("\n".join([",".join(HEADER), *rows]) + "\n")
    with pytest.raises(UserError, match=r"poses\.csv: t puts objects 0\.71 mm .* in meters\?"):
        read_poses_csv(file)
    file.write_text(
        "\n".join([rows[0], *(row.replace("0.1 0.0 0.7", "100 0 700") for row in rows)])
    )
    assert len(read_poses_csv(file)) == 4  # one of them may be wrong
