"""The programs that attack: what they try is noticed, and what goes unnoticed is told."""

import math
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import cv2
import pytest

BENCH = Path(__file__).parents[2] / "bench"
Load = Callable[[str], ModuleType]


@pytest.fixture
def load(load_script: Load, monkeypatch: pytest.MonkeyPatch) -> Load:
    """Return a function that imports a script of bench/, which imports its neighbors."""
    monkeypatch.syspath_prepend(str(BENCH))
    monkeypatch.setattr(sys, "path", [*sys.path])
    return lambda name: load_script(f"bench/{name}.py")


def test_spoiled_files_are_noticed(load: Load, capsys: pytest.CaptureFixture[str]) -> None:
    assert load("mutations").main(["12", "--seed", "7"]) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[0] == "12 mutations, seed 7"
    assert sum(int(line.split()[0]) for line in told[1:]) == 12


def test_what_nobody_notices_is_told(
    load: Load, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mutations = load("mutations")
    base = mutations.make_base("ycb_video", tmp_path / "base")
    work = tmp_path / "work"

    def tenth(folder: Path, rng: object) -> str:
        path = folder / "0001" / "000001-depth.png"
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED) // 10)
        return "a tenth"

    monkeypatch.setattr(mutations, "spoil", tenth)
    assert mutations.try_one(base, work, None)[1] == "accepted, and listed by check_data"
    monkeypatch.setattr(mutations, "list_problems", lambda *_: [])
    assert mutations.try_one(base, work, None)[1] == "wrong data accepted"
    monkeypatch.setattr(mutations, "judge", lambda *_: 1 / 0)
    assert mutations.try_one(base, work, None)[1] == "raw traceback"


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of what trainings of the same code can use: data, and those not killed."""
    return tmp_path_factory.mktemp("kept")


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["0", "2"])
@pytest.mark.parametrize("model", ["pose_pf", "patch_pf", "pixel_pf", "cnn_patch", "downsized"])
def test_killed_trainings_end_with_the_same_bits(
    load: Load, tmp_path: Path, kept: Path, model: str, workers: str
) -> None:
    """Twenty kills in all."""
    kills = load("kills")
    kills.prepare()
    counts = kills.kill_many(tmp_path, [(model, workers)], 2, seed=3, keep=kept)
    assert sum(counts.values()) == 2
    assert all(what.startswith("the same bits, killed") for what in counts), counts


def test_bits_that_differ_are_told(load: Load) -> None:
    assert load("kills").list_differing({"a": [1, 2]}, {"a": [1, 3]}) == [".a[1]"]


@pytest.mark.slow
def test_a_killed_sweep_does_each_job_once(load: Load, tmp_path: Path) -> None:
    sweeps = load("killed_sweeps")
    sweeps.prepare()
    counts, wrong = sweeps.kill_sweep(tmp_path, jobs=4, kills=2, seed=3, model="cnn_patch")
    assert wrong == []
    assert sum(count for what, count in counts.items() if what.startswith("killed ")) == 2
    assert [count for what, count in counts.items() if "jobs that" in what] == [4, 4]


def test_a_sweep_that_did_a_job_twice_is_told(load: Load, tmp_path: Path) -> None:
    sweeps = load("killed_sweeps")
    file = tmp_path / "seed=0" / "metrics.json"
    file.parent.mkdir()
    file.write_text("{}")
    (file.parent / ".hydra").mkdir()
    before = sweeps.list_done(tmp_path)
    (file.parent / ".hydra" / "config.yaml").write_text("")  # at each start
    assert sweeps.list_done(tmp_path) == before
    os.utime(file, ns=(1, 1))
    assert sweeps.list_done(tmp_path) != before


def test_a_process_is_followed_by_its_own_time(load: Load) -> None:
    """So that a kill falls where it was drawn, however busy the machine is."""
    kills = load("kills")
    number = os.fork()
    if not number:
        while time.process_time() < 0.5:
            pass
        os.kill(os.getpid(), signal.SIGSTOP)  # while it is suspended, its time stands
        os._exit(0)
    assert 0.1 <= kills.follow(number, 0.1) < 0.4
    os.waitpid(number, os.WUNTRACED)
    os.kill(number, signal.SIGCONT)
    assert 0.4 <= kills.follow(number, math.inf) < 1.0
    assert os.waitpid(number, 0) == (number, 0)


@pytest.mark.parametrize(
    ("status", "cpu", "err", "told"),
    [
        (0, 1, "", "accepted"),
        (2, 1, "train: seed=-1: must be\n", "refused in one line"),
        (70, 1, "Traceback (most recent call last)\n", "raw traceback"),
        (None, 1, "", "no answer within 20 s of processor time"),
        (0, 30, "", "no answer within 20 s of processor time"),
        (-11, 1, "", "ended by a signal"),
        (2, 1, "a\nb\n", "refused in several lines"),
        (2, 1, "", "refused without a word"),
    ],
)
def test_a_command_line_is_judged(
    status: int | None, cpu: float, err: str, told: str, load: Load
) -> None:
    fuzz = load("fuzz")
    assert fuzz.judge(fuzz.Ended(status, 1.0, cpu, "", err)) == told
