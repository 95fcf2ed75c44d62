"""The command `track`: on a folder of pictures, on a dataset, and its refusals."""

import csv
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from omegaconf import OmegaConf

from posefilter.cli.command import compose_job, run_command
from posefilter.cli.track import make_settings
from posefilter.cli.track_log import to_pose_row
from posefilter.data.sequences import VideoFrame
from posefilter.errors import UserError
from posefilter.locks import LOCK, hold
from posefilter.metrics.bop_results import read_poses_csv
from posefilter.tracking.records import TrackRow
from posefilter.tracking.settings import TrackerSettings
from posefilter.tracking.track import TrackResult
from posefilter.tracking.tracker import Tracker

pytestmark = pytest.mark.slow

HOME = Path(__file__).parents[2]
SCENE = HOME / "docs" / "scenes" / "003_cracker_box" / "mixed" / "scene0003_0"
FEW = [
    "filter.particles=100",
    "filter.initial_particles=300",
    "filter.steps=5",
    "filter/refine=none",
]
COMMON = ["checkpoint=003_cracker_box", "console=json", "threads=1", *FEW]
CAMERA = "intrinsics=533.39,533.74,156.24,120.41"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a picture four times, the third of them black and without depth."""
    stem = min(SCENE.glob("*.left.jpg")).name.removesuffix(".left.jpg")
    rgb = cv2.imread(str(SCENE / f"{stem}.left.jpg"))
    depth = cv2.imread(str(SCENE / f"{stem}.left.depth.png"), cv2.IMREAD_UNCHANGED)
    for name in ("rgb", "depth"):
        (tmp_path / "video" / name).mkdir(parents=True)
    for number in range(4):
        shown = number != 2
        name = f"frame_{8 + number}.png"
        cv2.imwrite(str(tmp_path / "video" / "rgb" / name), rgb * shown)
        cv2.imwrite(str(tmp_path / "video" / "depth" / name), depth * shown)
    return tmp_path / "video"


@pytest.mark.parametrize(("probability", "score"), [(0.25, 0.25), (None, 7.5)])
def test_a_row_is_scored_as_predict_and_evaluate_score(
    probability: float | None, score: float
) -> None:
    result: Any = SimpleNamespace(
        object="a", pose=np.eye(4), score=7.5, probability=probability, seconds=0.1
    )
    row = TrackRow("video", "8", 0, 8, 1, result, 0.1, None, np.nan, np.nan)
    assert to_pose_row(row, lambda _: np.eye(4)).score == score


def test_the_time_of_a_row_is_that_of_its_image_by_the_clock(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As BOP has it: times of objects that are tracked side by side overlap."""
    update_all = Tracker.update_all

    def update(self: Tracker, *frame: Any) -> list[TrackResult]:
        return [replace(one, seconds=1000.0) for one in update_all(self, *frame)]

    monkeypatch.setattr(Tracker, "update_all", update)
    typed = [*COMMON, f"frames={folder}", CAMERA, f"out={tmp_path / 'out'}"]
    before = time.perf_counter()
    assert run_command("track", HOME, typed) == 0
    times = [row.seconds for row in read_poses_csv(tmp_path / "out" / "poses.csv")]
    assert 0 < sum(times) < time.perf_counter() - before


def test_a_folder_of_pictures_is_tracked(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    typed = [*COMMON, f"frames={folder}", CAMERA, f"out={out}"]
    assert run_command("track", HOME, typed) == 0
    lines = [json.loads(line) for line in (out / "poses.jsonl").read_text().splitlines()]
    assert [one["status"] for one in lines] == ["started", "tracked", "tracked", "tracked"]
    assert lines[2]["objectness"] == 0
    places = np.array([one["camera_from_object"] for one in lines])[:, :3, 3]
    notes = json.loads(min(SCENE.glob("*.left.json")).read_text())
    truth = np.array(notes["objects"][0]["location"]) / 100
    assert np.abs(places - places[0]).max() < 0.03
    assert np.linalg.norm(places[3] - truth) < 0.2  # the mesh's origin is not FAT's
    with (out / "poses.csv").open() as file:
        assert [row["im_id"] for row in csv.DictReader(file)] == ["8", "9", "10", "11"]
    with (out / "tracks.csv").open() as file:
        named = [(row["frame"], row["im_id"]) for row in csv.DictReader(file)]
    assert named == [("frame_8", "8"), ("frame_9", "9"), ("frame_10", "10"), ("frame_11", "11")]
    metrics = json.loads((out / "metrics.json").read_text())["003_cracker_box"]
    assert metrics["frames"] == 4
    assert metrics["lost"] == 0
    assert "add" not in metrics
    video = cv2.VideoCapture(str(out / "video.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 4
    assert video.read()[1].std() > 20
    assert run_command("track", HOME, typed) == 2  # nothing is overwritten


def break_frame(folder: Path, which: str) -> Path:
    """Cut the file of the third frame off, or make its depth implausible or impossible."""
    if which == "depth beyond numbers":
        (folder / "depth" / "frame_10.png").unlink()
        path = folder / "depth" / "frame_10.npy"
        np.save(path, np.full((240, 320), 1e200))
        return path
    if which == "depth in other units":
        path = folder / "depth" / "frame_10.png"
        cv2.imwrite(str(path), np.full((240, 320), 100, np.uint16))
        return path
    path = folder / "rgb" / "frame_10.png"
    path.write_bytes((folder / "rgb" / "frame_9.png").read_bytes()[:5000])
    return path


@pytest.mark.parametrize("which", ["truncated", "depth in other units", "depth beyond numbers"])
def test_what_was_tracked_before_a_broken_frame_is_kept(
    which: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = break_frame(folder, which), tmp_path / "out"
    assert run_command("track", HOME, [*COMMON, f"frames={folder}", CAMERA, f"out={out}"]) == 2
    (told,) = capsys.readouterr().err.splitlines()
    assert path.name in told or f"frame {path.stem}:" in told
    assert "the 2 frames before it are in" in told
    assert "on_error=skip" in told
    lines = [json.loads(line) for line in (out / "poses.jsonl").read_text().splitlines()]
    assert [one["frame"] for one in lines] == ["frame_8", "frame_9"]
    with (out / "poses.csv").open() as file:
        assert [row["im_id"] for row in csv.DictReader(file)] == ["8", "9"]
    assert json.loads((out / "metrics.json").read_text())["003_cracker_box"]["frames"] == 2
    video = cv2.VideoCapture(str(out / "video.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 2
    assert not list(out.glob(".*part*"))


def test_what_was_tracked_before_an_interruption_is_kept(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[str] = []

    def draw(frame: VideoFrame, *_: object) -> np.ndarray:
        seen.append(frame.name)
        if len(seen) == 3:
            raise KeyboardInterrupt
        return frame.rgb

    monkeypatch.setattr("posefilter.cli.track.draw_frame", draw)
    out = tmp_path / "out"
    assert run_command("track", HOME, [*COMMON, f"frames={folder}", CAMERA, f"out={out}"]) == 130
    with (out / "poses.csv").open() as file:
        assert [row["im_id"] for row in csv.DictReader(file)] == ["8", "9"]


PATCHED = """
import os, sys
from pathlib import Path
from posefilter.cli import track
from posefilter.cli.command import run_command

calls = []
def send(*arguments):
    calls.append(arguments)
    if len(calls) == {call}:
        os.kill(os.getpid(), {number})
    return arguments[0].rgb

track.{patched} = send
os._exit(run_command("track", Path({home!r}), sys.argv[1:]))
"""


def run_interrupted(arguments: list[str], patched: str, call: int, number: int) -> int:
    """Run the command in a process of its own, which gets a signal in a call of one of its
    functions, the first, third and so on; return its status.

    It is no fork of this one: a fork has none of the threads that earlier tests have started, and
    may wait for one of them forever.
    """
    code = PATCHED.format(patched=patched, call=call, number=number, home=str(HOME))
    done = subprocess.run([sys.executable, "-c", code, *arguments], check=False, timeout=120)
    return done.returncode


@pytest.mark.parametrize(
    ("patched", "call", "frames"),
    [("draw_frame", 3, ["8", "9"]), ("write_rows", 1, ["8", "9", "10", "11"])],
    ids=["in a frame", "while it writes the results"],
)
def test_what_was_tracked_before_a_kill_is_kept(
    patched: str,
    call: int,
    frames: list[str],
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    typed = [*COMMON, f"frames={folder}", CAMERA, f"out={out}", "save_video=none"]
    assert run_interrupted(typed, patched, call, signal.SIGKILL) == -signal.SIGKILL
    lines, poses = out / "poses.partial.jsonl", out / "poses.partial.csv"
    left = {file: file.read_bytes() for file in (lines, poses)}
    assert {file.name for file in out.iterdir()} == {LOCK, lines.name, poses.name}
    assert run_command("track", HOME, typed) == 2
    (told,) = capsys.readouterr().err.splitlines()
    assert f"out={out}: holds {len(frames)} frames of a track.py that was cut off" in told
    assert left == {file: file.read_bytes() for file in (lines, poses)}
    rows = [json.loads(line) for line in left[lines].splitlines()]
    kept = read_poses_csv(poses)
    assert [str(row.im_id) for row in kept] == [str(row["im_id"]) for row in rows] == frames
    for row, line in zip(kept, rows, strict=True):
        assert np.array_equal(row.camera_from_native, line["camera_from_object"])


@pytest.mark.parametrize("name", ["poses.partial.csv", "poses.partial.jsonl"])
def test_what_a_killed_one_has_left_is_not_touched_whatever_it_is(
    name: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / name).write_bytes(b"\xff\n" * 3)
    assert run_command("track", HOME, [*COMMON, f"frames={folder}", CAMERA, f"out={out}"]) == 2
    assert "of a track.py that was cut off" in capsys.readouterr().err
    assert [file.name for file in out.iterdir()] == [name]


def test_what_was_tracked_before_a_sigterm_is_kept(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    typed = [*COMMON, f"frames={folder}", CAMERA, f"out={out}"]
    status = run_interrupted(typed, "draw_frame", 3, signal.SIGTERM)
    assert status == 128 + signal.SIGTERM
    assert [row.im_id for row in read_poses_csv(out / "poses.csv")] == [8, 9]
    assert cv2.VideoCapture(str(out / "video.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 2
    assert {file.name for file in out.iterdir()} == {
        "metrics.json", "poses.csv", "poses.jsonl", "tracks.csv", "video.mp4",
    }  # fmt: skip


def test_a_broken_frame_can_be_left_out(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = break_frame(folder, "truncated"), tmp_path / "out"
    typed = [*COMMON, f"frames={folder}", CAMERA, f"out={out}", "on_error=skip"]
    assert run_command("track", HOME, typed) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    warned = next(line for line in lines if "skipped" in line)
    assert str(path) in warned["skipped"]
    with (out / "poses.csv").open() as file:
        assert [row["im_id"] for row in csv.DictReader(file)] == ["8", "9", "11"]


def test_a_frame_without_depth_can_be_left_out(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "depth" / "frame_9.png").unlink()
    typed = [*COMMON, f"frames={folder}", CAMERA]
    assert run_command("track", HOME, [*typed, f"out={tmp_path / 'none'}"]) == 2
    assert "of 4, and the others have; on_error=skip leaves such" in capsys.readouterr().err
    out = tmp_path / "out"
    assert run_command("track", HOME, [*typed, f"out={out}", "on_error=skip"]) == 0
    assert "frame_9.png: missing file" in capsys.readouterr().out
    with (out / "poses.csv").open() as file:
        assert [row["im_id"] for row in csv.DictReader(file)] == ["8", "10", "11"]


def test_progress_counts_the_frames(
    folder: Path, tmp_path: Path, bar_tasks: Callable[[str], list[Any]]
) -> None:
    seen = bar_tasks("posefilter.cli.track.bars")
    typed = [*COMMON, f"frames={folder}", CAMERA, "save_video=none", f"out={tmp_path / 'out'}"]
    assert run_command("track", HOME, typed) == 0
    assert [(one.completed, one.total) for one in seen] == [(4, 4)]


def test_a_first_frame_that_is_broken_leaves_nothing(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "rgb" / "frame_8.png").write_bytes(b"")
    out = tmp_path / "out"
    assert run_command("track", HOME, [*COMMON, f"frames={folder}", CAMERA, f"out={out}"]) == 2
    (told,) = capsys.readouterr().err.splitlines()
    assert "frame_8.png: truncated or corrupt image" in told
    assert not out.exists()


def test_what_is_lost_in_every_frame_is_told_with_a_cause(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    typed = [*COMMON, f"frames={folder}", CAMERA, f"out={tmp_path / 'out'}", "depth_scale=600"]
    assert run_command("track", HOME, typed) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    warned = [line for line in lines if line["event"] == "warning"][-1]
    assert warned["object"] == "003_cracker_box"
    assert "depth_scale" in warned["reason"]


@pytest.mark.parametrize("factor", [1.0, 1.25])
def test_a_wrong_depth_scale_is_told_once(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], factor: float
) -> None:
    scale = f"depth_scale={10000 / factor}"  # units in a meter; 10000 is right
    typed = [*COMMON, f"frames={folder}", CAMERA, f"out={tmp_path / 'out'}", scale]
    assert run_command("track", HOME, typed) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    warned = [line for line in lines if line["event"] == "warning"]
    blank = warned.pop()  # the third frame, which is black
    assert (blank["frame"], len(blank["warnings"])) == ("frame_10", 2)
    assert "the color image is black" in blank["warnings"][0]
    assert len(warned) == (factor != 1.0)
    for line in warned:
        assert line["frame"] == "frame_8"
        assert any("times as large as its mesh" in one for one in line["warnings"])
    rows = [json.loads(line) for line in (tmp_path / "out/poses.jsonl").read_text().splitlines()]
    assert rows[0]["scale_ratio"] == pytest.approx(factor, abs=0.1)
    with (tmp_path / "out/tracks.csv").open() as file:
        ratios = [row["scale_ratio"] for row in csv.DictReader(file)]
    assert ratios == [str(row["scale_ratio"] or "") for row in rows]
    assert [row["verdict"] for row in rows] == [None, None, "unsure", None]  # not calibrated


def test_without_the_viewers_library_a_view_is_refused_before_anything_is_done(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    out = tmp_path / "out"
    typed = [*COMMON, f"frames={folder}", CAMERA, f"out={out}", "save_rerun=true"]
    assert run_command("track", HOME, typed) == 2
    assert "rerun-sdk is missing" in "".join(capsys.readouterr())
    assert not out.exists()


@pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="needs the extra [viz]")
def test_a_view_of_the_tracks_is_written(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    typed = [
        *COMMON,
        f"frames={folder}",
        CAMERA,
        f"out={out}",
        "save_rerun=true",
        "save_video=none",
    ]
    assert run_command("track", HOME, typed) == 0
    assert (out / "view.rrd").stat().st_size > 10_000
    assert json.loads(capfd.readouterr().out.splitlines()[-1])["next"] == [f"rerun {out}/view.rrd"]


def test_a_scene_of_a_dataset_is_tracked_with_its_errors(tmp_path: Path) -> None:
    """Its frames are of one scene each: a video of one frame is a single estimate."""
    root = SCENE.parents[1]
    typed = [*COMMON, "data=fat", f"data.root={root}", "scene=scene0003_0", "save_video=gif"]
    assert run_command("track", HOME, [*typed, f"out={tmp_path}"]) == 0
    (line,) = [json.loads(line) for line in (tmp_path / "poses.jsonl").read_text().splitlines()]
    metrics = json.loads((tmp_path / "metrics.json").read_text())["003_cracker_box"]
    assert metrics["add"]["median_mm"] == pytest.approx(line["add_mm"], rel=1e-4)
    assert line["add_s_mm"] <= line["add_mm"] < 40
    assert metrics["jitter_mm"] is None
    assert (tmp_path / "video.gif").stat().st_size > 1000


def test_a_video_of_which_no_frame_was_read_is_not_listed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    root, out = tmp_path / "data", tmp_path / "out"
    for name in (SCENE.name, "scene0004_0"):
        shutil.copytree(SCENE.with_name(name), root / SCENE.parent.name / name)
    (image,) = (root / SCENE.parent.name / "scene0004_0").glob("*.left.jpg")
    image.write_bytes(b"")
    typed = [*COMMON, "data=fat", f"data.root={root}", "save_video=gif", "on_error=skip"]
    assert run_command("track", HOME, [*typed, f"out={out}"]) == 0
    (line,) = [one for one in capfd.readouterr().out.splitlines() if '"tracked"' in one]
    files = json.loads(line)["files"]
    assert [name for name in files if name.startswith("video")] == [f"video_{SCENE.name}"]
    assert all(Path(file).is_file() for file in files.values())


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (["frames=FOLDER"], "intrinsics: is missing"),
        ([], "give either frames=DIR, or data="),
        (["frames=FOLDER", CAMERA, "data=fat"], "give either frames=DIR, or data="),
        (["frames=FOLDER", CAMERA, "+data.root=FOLDER"], "give either frames=DIR, or data="),
        (["frames=FOLDER", CAMERA, "scene=1"], "scene=1: is one of a dataset; frames=DIR is"),
        (["data=fat", "data.root=FOLDER", CAMERA], "intrinsics: only valid with frames=DIR"),
        (
            ["data=fat", "data.root=FOLDER", "depth_scale=1000"],
            "depth_scale: only valid with frames=DIR",
        ),
        (["frames=FOLDER", CAMERA, "on_error=stop"], "on_error=stop: choose raise or skip"),
        (["frames=FOLDER", CAMERA, "stride=0"], "stride=0: must be a whole number"),
        (["frames=FOLDER", CAMERA, "save_video=avi"], "save_video=avi: choose mp4, gif, none"),
        (["frames=FOLDER", CAMERA, "fps=1e-9"], "fps=1e-09: must be a number, at least 0.1"),
        (["frames=FOLDER", CAMERA, "tracker=null"], "tracker=null: track requires a value"),
        (["frames=FOLDER/rgb", CAMERA], "has no folder rgb/"),
        (["frames=FOLDER/rgb/frame_8.png", CAMERA], "frame_8.png: is a file, and no folder"),
        (["frames=FOLDER", CAMERA, "tracker.patience=0"], "patience=0: must be a whole number"),
        (
            ["frames=FOLDER", CAMERA, "tracker.motion.translation_mm=fast"],
            "motion.translation_mm=fast",
        ),
    ],
)
def test_a_mistake_is_one_line(
    wrong: list[str], told: str, folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    typed = [one.replace("FOLDER", str(folder)) for one in wrong]
    assert run_command("track", HOME, [*COMMON, *typed, f"out={tmp_path / 'out'}"]) == 2
    assert [told in line for line in capfd.readouterr().err.splitlines()] == [True]


def test_two_checkpoints_of_one_object_are_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Their rows and figures would be mixed."""
    copied = tmp_path / "own.ckpt"
    shutil.copy(HOME / "weights" / "003_cracker_box.ckpt", copied)
    typed = [*COMMON[1:], f"checkpoint=[003_cracker_box,{copied}]", f"frames={folder}", CAMERA]
    assert run_command("track", HOME, [*typed, f"out={tmp_path / 'out'}"]) == 2
    assert "checkpoint: 2 of them are of 003_cracker_box" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_folder_has_one_track_at_a_time(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    number = os.fork()
    if number == 0:
        hold(tmp_path / "out")
        time.sleep(60)
        os._exit(0)
    while not (tmp_path / "out" / LOCK).exists():
        time.sleep(0.01)
    typed = [*COMMON, f"frames={folder}", CAMERA, f"out={tmp_path / 'out'}"]
    try:
        assert run_command("track", HOME, typed) == 2
    finally:
        os.kill(number, signal.SIGKILL)
        os.waitpid(number, 0)
    assert f"track: {tmp_path / 'out'}: is in use by another run" in capfd.readouterr().err


def test_the_commands_defaults_are_the_librarys(tmp_path: Path) -> None:
    job = compose_job("track", HOME / "conf", [], tmp_path)
    made, own = make_settings(job.cfg.tracker), TrackerSettings()
    assert vars(made.motion) == vars(own.motion)
    assert {**vars(made), "motion": 0} == {**vars(own), "motion": 0}
    assert {*OmegaConf.to_container(job.cfg.tracker)} == {*vars(own)}


def test_a_section_that_is_switched_off_is_told(tmp_path: Path) -> None:
    job = compose_job("track", HOME / "conf", ["tracker.follow=null"], tmp_path)
    with pytest.raises(UserError, match=r"tracker\.follow=None: must be a section"):
        make_settings(job.cfg.tracker)
