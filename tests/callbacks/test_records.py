"""Results on disk: what is read is what was written, and what is malformed is named."""

import math
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from posefilter.callbacks.records import Outcome, collect_outcomes, to_rows, write_beliefs
from posefilter.data.frames import FrameRecord
from posefilter.errors import UserError
from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import random_rotation
from posefilter.metrics.bop_results import (
    HEADER,
    PoseRow,
    choose_score,
    measure_seconds,
    read_poses_csv,
    to_mesh,
    to_native,
    write_poses_csv,
)
from posefilter.types import Batch, BeliefBatch


def poses(count: int, seed: int = 0) -> np.ndarray:
    g = torch.Generator().manual_seed(seed)
    return make_pose(
        random_rotation(count, generator=g).double(), torch.randn(count, 3, generator=g).double()
    ).numpy()


def record(i: int) -> FrameRecord:
    return FrameRecord(f"0048/{i:06d}", "0048", 48, i, 2, "003_cracker_box", 0, ())


def test_round_trip_is_exact(tmp_path: Path) -> None:
    written = [PoseRow(48, i, 2, 1 / (i + 3), pose, 0.1 * i) for i, pose in enumerate(poses(50))]
    written[3].camera_from_native[:3, 3] = [1e-17, -0.0, 123456.789]
    path = tmp_path / "deep" / "poses.csv"
    write_poses_csv(path, written)
    for a, b in zip(written, read_poses_csv(path), strict=True):
        assert a[:4] == b[:4]
        assert a.seconds == b.seconds
        assert (a.camera_from_native == b.camera_from_native).all()


def test_file_is_as_bop_wants_it(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    pose[:3, 3] = [0.1, -0.02, 0.755]
    write_poses_csv(tmp_path / "poses.csv", [PoseRow(48, 1, 2, 0.5, pose, -1.0)])
    lines = (tmp_path / "poses.csv").read_text().splitlines()
    assert lines[0] == "scene_id,im_id,obj_id,score,R,t,time"
    cells = lines[1].split(",")
    assert cells[:4] == ["48", "1", "2", "0.5"]
    assert [float(x) for x in cells[4].split(" ")] == [0, -1, 0, 1, 0, 0, 0, 0, 1]
    assert [float(x) for x in cells[5].split(" ")] == [100, -20, 755]
    assert cells[6] == "-1.0"


def test_a_score_is_the_probability_where_there_is_one() -> None:
    assert choose_score(0.25, 7.5) == 0.25
    assert choose_score(0.0, 7.5) == 0
    assert choose_score(None, 7.5) == choose_score(np.nan, 7.5) == 7.5
    # of a frame that shows nothing, whose pose a track predicts
    blank = choose_score(None, -np.inf)
    assert np.isfinite(blank)
    assert blank < choose_score(None, -1e6)


def test_header_may_be_missing_and_numbers_plain(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("48,1,2,0.9,1 0 0 0 1 0 0 0 1,1e2 -20 7.5E2,-1\n\n")
    (row,) = read_poses_csv(path)
    assert row.camera_from_native[:3, 3].tolist() == [0.1, -0.02, 0.75]


GOOD = "48,1,2,0.9,1 0 0 0 1 0 0 0 1,100 -20 750,-1"


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("48,1,2,0.9,1 0 0 0 1 0 0 0 1,100 -20 750", "6 columns, expected 7"),
        ("48,a,2,0.9,1 0 0 0 1 0 0 0 1,100 -20 750,-1", "im_id is 'a'"),
        ("48,1,2,0.9,1 0 0 0 1 0 0 0,100 -20 750,-1", "R has 8 numbers, expected 9"),
        ("48,1,2,0.9,1 0 0 0 1 0 0 0 2,100 -20 750,-1", "R is no rotation"),
        ("48,1,2,0.9,1 0 0 0 1 0 0 0 -1,100 -20 750,-1", "R is no rotation"),
        ("48,1,2,0.9,1 0 0 0 1 0 0 0 1,100 x 750,-1", "t holds something that is no number"),
        ("48,1,2,0.9,1 0 0 0 1 0 0 0 1,100 nan 750,-1", "t is not finite"),
        ("48,1,2,0.9,1 0 0 0 1 0 0 0 1e400,100 -20 750,-1", "R is not finite"),
        ("48,1,2,0.9,1 0 0 0 1 0 0 0 1,100 -20 1e999999999999999999,-1", "t is not finite"),
        ("48,1,2,0.9,1 0 0 0 1 0 0 0 1,100 -20 750,snan", "time is no number"),
        ("48,1,2,0.9," + "1" * 200_000 + ",100 -20 750,-1", "is no line of a table (field larger"),
        ("48,1,2,,1 0 0 0 1 0 0 0 1,100 -20 750,-1", "score has 0 numbers"),
    ],
)
def test_malformed_lines_are_named(tmp_path: Path, line: str, says: str) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("\n".join([",".join(HEADER), GOOD, line]) + "\n")
    with pytest.raises(UserError, match="line 3: ") as caught:
        read_poses_csv(path)
    assert says in str(caught.value)
    assert str(path) in str(caught.value)
    with pytest.raises(UserError, match="no such file"):
        read_poses_csv(tmp_path / "other.csv")


def test_native_poses_map_native_points_to_the_same_points() -> None:
    camera_from_object, native_from_mesh = poses(4), poses(1, seed=1)[0]
    point = np.array([0.03, -0.02, 0.1, 1.0])
    native = to_native(camera_from_object, native_from_mesh)
    assert np.abs(native @ (native_from_mesh @ point) - camera_from_object @ point).max() < 1e-12
    assert np.abs(to_mesh(native, native_from_mesh) - camera_from_object).max() < 1e-6


def test_rows_are_native_and_leave_out_what_is_not_finite() -> None:
    native_from_mesh = poses(1, seed=1)[0]
    estimates = poses(3)
    estimates[1, 0, 3] = np.nan
    none = np.zeros((0, 4, 4), np.float32), np.zeros(0, np.float32)
    outcomes = [Outcome(2 - i, estimates[i], float(i), np.nan, *none) for i in range(3)]
    rows = to_rows(outcomes, [record(i) for i in range(3)], lambda name: native_from_mesh)
    assert [(r.scene_id, r.im_id, r.obj_id, r.score, r.seconds) for r in rows] == [
        (48, 2, 2, 0.0, -1.0),
        (48, 0, 2, 2.0, -1.0),
    ]
    assert np.abs(rows[1].camera_from_native @ native_from_mesh - estimates[2]).max() < 1e-6


def test_the_time_of_an_image_is_that_of_all_its_instances() -> None:
    """As BOP has it, whose toolkit refuses rows of one image that differ in it."""
    estimates = poses(3)
    estimates[1, 0, 3] = np.nan  # takes time, too
    none = np.zeros((0, 4, 4), np.float32), np.zeros(0, np.float32)
    outcomes = [Outcome(i, estimates[i], 1.0, 0.25 * 2**i, *none) for i in range(3)]
    records = [record(0), record(0), record(1)]
    rows = to_rows(outcomes, records, lambda name: np.eye(4))
    assert [(r.im_id, r.seconds) for r in rows] == [(0, 0.75), (1, 1.0)]


def test_the_mean_time_is_that_of_images_and_not_of_their_objects() -> None:
    def row(image: int, number: int, seconds: float) -> PoseRow:
        return PoseRow(1, image, number, 1.0, np.eye(4), seconds)

    own = [row(0, 1, 0.4), row(0, 2, 0.4), row(0, 3, 0.4), row(1, 1, 0.1)]
    assert measure_seconds(own) == (pytest.approx(0.25), 0)
    # times of one class each, of which two instances have the same
    apart = [row(0, 1, 0.1), row(0, 1, 0.1), row(0, 2, 0.3), row(1, 1, 0.2)]
    assert measure_seconds(apart) == (pytest.approx(0.3), 1)
    unknown = [row(0, 1, -1.0), row(0, 2, 0.3), row(1, 1, math.nan)]
    assert measure_seconds(unknown) == (None, 0)
    assert measure_seconds([*unknown, row(2, 1, 0.5)]) == (0.5, 0)


def test_files_of_several_objects_are_put_together_as_the_page_has_it(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "instances.md").read_text()
    (command,) = re.findall(r"^    (\(head -1 outputs/bop/.*)$", page, re.MULTILINE)
    estimates = poses(4)
    # of the second object two instances in image 1
    files = {"2": [(1, 0.25), (2, 0.5)], "5": [(1, 1.0), (1, 1.0)]}
    for name, own in files.items():
        folder = tmp_path / "outputs" / "bop" / name
        folder.mkdir(parents=True)
        rows = [
            PoseRow(48, image, int(name), 0.5, estimates[i], seconds)
            for i, (image, seconds) in enumerate(own)
        ]
        write_poses_csv(folder / "poses.csv", rows)
    subprocess.run(command, shell=True, check=True, cwd=tmp_path)
    rows = read_poses_csv(tmp_path / "outputs" / "bop" / "poses.csv")
    found = [(r.im_id, r.obj_id, r.seconds) for r in rows]
    assert found == [(1, 2, 1.25), (2, 2, 0.5), (1, 5, 1.25), (1, 5, 1.25)]
    assert np.array_equal(rows[1].camera_from_native, estimates[1])
    assert measure_seconds(rows) == (pytest.approx(0.875), 0)


def test_outcomes_and_beliefs(tmp_path: Path) -> None:
    history = torch.from_numpy(poses(8)).reshape(2, 4, 4, 4)
    weights = torch.tensor([[0.1, 0.2, 0.3, 0.4], [0.25] * 4])
    belief = BeliefBatch(history, weights.log(), history[:, 1], torch.tensor([1.5, -2.0]))
    empty = torch.zeros(2)
    batch = Batch(empty, empty, empty, empty, empty, empty, torch.tensor([1, 0]), empty)
    outcomes = collect_outcomes(belief, batch, 0.25, [math.nan] * 2)
    assert [(o.frame_id, o.score, o.seconds) for o in outcomes] == [(1, 1.5, 0.25), (0, -2.0, 0.25)]
    assert (outcomes[0].estimate == history[0, 1].numpy()).all()
    native_from_mesh = poses(1, seed=3)[0]
    write_beliefs(
        tmp_path / "beliefs.npz", outcomes, [record(7), record(9)], lambda name: native_from_mesh
    )
    with np.load(tmp_path / "beliefs.npz") as found:
        assert found["im_id"].tolist() == [9, 7]
        assert np.abs(found["weights"] - weights.numpy()).max() < 1e-6
        assert np.abs(found["poses"] @ native_from_mesh - history.numpy()).max() < 1e-5
