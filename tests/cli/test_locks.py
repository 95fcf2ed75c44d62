"""One run a folder: the lock of a run that was killed is free, that of one that lives is not."""

import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from posefilter.cli import run_command
from posefilter.errors import UserError
from posefilter.files import GrowingFile, open_whole, remove_parts
from posefilter.locks import LOCK, hold, release

HOME = Path(__file__).parents[2]


@pytest.fixture
def holder() -> Iterator[Callable[[Path], int]]:
    """Return a function that starts a process which holds a folder, and returns its number."""
    started = []

    def start(folder: Path) -> int:
        number = os.fork()
        if number == 0:
            hold(folder)
            (folder / "held").touch()
            time.sleep(60)
            os._exit(0)
        started.append(number)
        while not (folder / "held").exists():
            time.sleep(0.01)
        (folder / "held").unlink()
        return number

    yield start
    for number in started:
        end(number)


def end(number: int) -> None:
    try:
        os.kill(number, signal.SIGKILL)
        os.waitpid(number, 0)
    except (ProcessLookupError, ChildProcessError):  # ended by the test
        pass


def test_a_folder_is_free_once_its_holder_was_killed(
    holder: Callable[[Path], int], tmp_path: Path
) -> None:
    number = holder(tmp_path)
    with pytest.raises(UserError, match=rf"is in use by another run \(process {number} on"):
        hold(tmp_path)
    end(number)
    assert (tmp_path / LOCK).exists()  # nobody was left to remove it
    assert hold(tmp_path)
    assert not hold(tmp_path)  # held already
    release(tmp_path)
    assert not list(tmp_path.iterdir())


def test_one_may_wait_for_a_folder(holder: Callable[[Path], int], tmp_path: Path) -> None:
    number = holder(tmp_path)
    os.kill(number, signal.SIGKILL)
    assert hold(tmp_path, wait=True)
    release(tmp_path)


@pytest.mark.parametrize("typed", [[], ["-m", "seed=1,2"]], ids=["a run", "a sweep"])
def test_a_second_run_is_refused_before_it_writes(
    typed: list[str],
    holder: Callable[[Path], int],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    holder(tmp_path)
    nowhere = "data.root=/nonexistent"
    assert run_command("train", HOME, [*typed, nowhere, f"out={tmp_path}", "console=json"]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f"train: {tmp_path}: is in use by another run")
    assert [path.name for path in tmp_path.iterdir()] == [LOCK]


def test_what_a_killed_writer_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / "checkpoints").mkdir()
    number = os.fork()
    if number == 0:
        with open_whole(tmp_path / "checkpoints" / "last.ckpt") as file:
            file.write(b"half")
            file.flush()
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(number, 0)
    (part,) = (tmp_path / "checkpoints").iterdir()
    assert part.name.startswith(".last.ckpt.")
    remove_parts(tmp_path, ["checkpoints"], seconds=60)
    assert part.exists()  # too young
    remove_parts(tmp_path, [".", "checkpoints"])
    assert not list((tmp_path / "checkpoints").iterdir())


def test_a_file_that_grows_is_on_the_disk_after_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, synced = [100.0], list[str]()
    file = GrowingFile(tmp_path / "a")
    monkeypatch.setattr("posefilter.files.time.monotonic", lambda: now[0])
    monkeypatch.setattr("os.fsync", lambda _: synced.append((tmp_path / "a").read_text()))
    for piece in "abcd":
        file.add(piece)
        now[0] += 0.6
    assert "a" in synced  # its name is on the disk, and its first piece
    assert synced[-1] == "abc"
    with pytest.raises(UserError, match="a: cannot be written"):  # of another: it is not touched
        GrowingFile(tmp_path / "a").add("x")
    assert (tmp_path / "a").read_text() == "abcd"


def test_a_checkpoint_of_a_training_that_runs_is_not_calibrated_in_place(
    tmp_path: Path, holder: Callable[[Path], int], capfd: pytest.CaptureFixture[str]
) -> None:
    """It would write an older one over a better one that the training has written meanwhile."""
    file = tmp_path / "run" / "checkpoints" / "best.ckpt"
    file.parent.mkdir(parents=True)
    shutil.copy(HOME / "weights" / "003_cracker_box.ckpt", file)
    before = file.read_bytes()
    holder(tmp_path / "run")
    assert run_command("calibrate", HOME, [f"checkpoint={file}", "overwrite=true"]) == 2
    assert f"{tmp_path / 'run'}: is in use by another run" in capfd.readouterr().err
    assert file.read_bytes() == before
