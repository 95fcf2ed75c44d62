"""On a full disk whatever is written ends in one line, and nothing half is left under its name."""

import ctypes
import errno
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.tensorboard import SummaryWriter

from posefilter.belief import Belief
from posefilter.callbacks.records import write_beliefs
from posefilter.checking.contact_figure import write_sheet
from posefilter.cli import run_command
from posefilter.cli.console import JSON, settle_logging
from posefilter.cli.explain import explain
from posefilter.cli.files import save_whole
from posefilter.cli.results import write_json
from posefilter.data.cache import DiskCache
from posefilter.data.frames import FrameRecord, Sample
from posefilter.errors import UserError
from posefilter.figures.canvas import save_image
from posefilter.figures.video import VideoWriter
from posefilter.files import GrowingFile
from posefilter.metrics.bop_results import PoseRow, write_poses_csv
from posefilter.metrics.image_errors import ImageError, write_errors
from posefilter.synthetic.fat_format import write_image

HOME = Path(__file__).parents[2]
KILOBYTES = 64
_READ_ONLY = 1  # of mount(2)
NOISE = np.random.default_rng(0).integers(0, 256, (300, 300, 3), dtype=np.uint8)


@contextmanager
def mounted(folder: Path, flags: int = 0) -> Iterator[Path]:
    """Mount a file system of 64 kB at a folder; skip where none can be mounted."""
    libc = ctypes.CDLL(None, use_errno=True)
    size = f"size={KILOBYTES}k".encode()
    if libc.mount(b"tmpfs", os.fsencode(folder), b"tmpfs", flags, size) != 0:
        pytest.skip("no file system can be mounted here")
    try:
        yield folder
    finally:
        libc.umount2(os.fsencode(folder), 2)


@pytest.fixture(scope="module")
def full_disk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return the folder of a file system of 64 kB."""
    with mounted(tmp_path_factory.mktemp("disk")) as folder:
        yield folder


def belief(path: Path) -> None:
    samples, random = np.tile(np.eye(4), (20_000, 1, 1)), np.random.default_rng(0)
    samples[:, :3, 3] = random.random((20_000, 3))
    weights = random.random(20_000)
    Belief(samples, weights / weights.sum(), np.zeros(3), 0.1, 0.2, "toy").save(path)


def beliefs(path: Path) -> None:
    outcome: Any = type("", (), {"frame_id": 0, "weights": np.ones(4000, np.float32)})()
    outcome.poses = np.tile(np.eye(4), (4000, 1, 1)) + NOISE.ravel()[:64_000].reshape(4000, 4, 4)
    write_beliefs(path, [outcome] * 3, [record()], lambda name: np.eye(4))


def record() -> FrameRecord:
    return FrameRecord("a/0", "a", 0, 0, 1, "toy", 0, ())


def cache(path: Path) -> None:
    sample = Sample(NOISE, NOISE[..., 0] / 100, NOISE[..., 0] > 99, np.eye(3), np.eye(4), 0, 0, 1.0)
    DiskCache(path, "1").keep(record(), sample)


ROW = PoseRow(1, 2, 3, 0.5, np.eye(4), 0.1)
ERROR = ImageError(*([0.5] * len(ImageError._fields)))._replace(image="a.png")  # type: ignore[arg-type]
WRITERS: dict[str, Callable[[Path], object]] = {
    "checkpoint": lambda path: save_whole({"w": torch.rand(100_000)}, path),
    "belief": belief,
    "beliefs": beliefs,
    "poses": lambda path: write_poses_csv(path, [ROW] * 2000),
    "errors": lambda path: write_errors(path, [ERROR] * 5000),
    "metrics": lambda path: write_json(path, [0.5] * 50_000),
    "picture": lambda path: save_image(NOISE, path),
    "contact sheet": lambda path: write_sheet(path, [NOISE]),
    "render": lambda path: write_image(path, NOISE),
    "cache": cache,
}


@pytest.mark.parametrize("kind", WRITERS)
def test_a_full_disk_is_one_line_and_leaves_nothing_half(kind: str, full_disk: Path) -> None:
    name = {"belief": "a.npz", "render": "a.png"}.get(kind, "a")
    with pytest.raises(UserError, match=r"cannot be written \(No space left on device\)") as caught:
        WRITERS[kind](full_disk / name)
    assert str(caught.value).startswith(str(full_disk))
    assert "\n" not in str(caught.value)
    left = [p for p in full_disk.rglob("*") if p.is_file() and p.name != "README"]
    assert left == []


def film(path: Path) -> None:
    with VideoWriter(path, "mp4", 10) as writer:
        for number in range(30):
            writer.add(np.roll(NOISE, 7 * number, 1))


def test_a_full_disk_leaves_no_video(full_disk: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UserError, match=r"video\.mp4: cannot be written \(.* of 30 frames"):
        film(full_disk / "video")
    assert not [*full_disk.glob("*video*")]
    assert capfd.readouterr().err == ""


def test_a_full_disk_ends_a_file_that_grows_at_a_whole_piece(full_disk: Path) -> None:
    file, piece = GrowingFile(full_disk / "grown"), "0123456\n" * 1250
    fitting = KILOBYTES * 1024 // len(piece)
    for _ in range(fitting):
        file.add(piece)
    with pytest.raises(UserError, match=r"grown: cannot be written \(No space left on device\)"):
        file.add(piece)
    file.close()
    assert (full_disk / "grown").read_text() == piece * fitting
    (full_disk / "grown").unlink()
    with pytest.raises(UserError, match="cannot be written"):
        GrowingFile(full_disk / "none").add("0" * 1024 * KILOBYTES * 2)
    assert not (full_disk / "none").exists()


@pytest.mark.parametrize("command", ["predict", "track", "check_data", "evaluate"])
def test_a_folder_on_a_disk_that_may_only_be_read_is_one_line(
    command: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    scene = HOME / "docs" / "scenes" / "003_cracker_box" / "mixed"
    settings = {"check_data": ["data=fat", "data.object=003_cracker_box", f"data.root={scene}"]}
    typed = settings.get(command, ["checkpoint=003_cracker_box"])
    with mounted(tmp_path, _READ_ONLY) as folder:
        assert run_command(command, HOME, [*typed, f"out={folder}"]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f"{command}: {tmp_path}")
    assert line.endswith("(Read-only file system)")


def test_a_full_disk_under_tensorboard_is_raised_and_not_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Its thread writes events, and hands what it failed by to the next one that is written."""
    full = OSError(errno.ENOSPC, "No space left on device")

    def refuse(*_: object) -> None:
        raise full

    monkeypatch.setattr(threading, "excepthook", threading.excepthook)
    settle_logging(JSON)
    board = SummaryWriter(str(tmp_path))
    writer = board._get_file_writer().event_writer._async_writer._worker
    monkeypatch.setattr(writer._record_writer, "write", refuse)
    board.add_scalar("loss", 1.0, 0)
    writer.join(timeout=30)
    with pytest.raises(OSError, match="No space left"):
        board.flush()
    assert "Traceback" not in capfd.readouterr().err
    assert explain(full, "train", tmp_path, []).startswith("the disk is full")


def test_what_another_thread_fails_by_is_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(threading, "excepthook", threading.excepthook)
    settle_logging(JSON)
    failing = threading.Thread(target=lambda: (_ for _ in ()).throw(OSError("lost")).__next__())
    failing.start()
    failing.join()
    assert "lost" in capsys.readouterr().err
