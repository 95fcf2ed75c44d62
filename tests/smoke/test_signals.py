"""A signal to all processes of a command, as a terminal or a job scheduler sends it."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from tests.smoke.conftest import HOME, TINY

_LONGEST = 120.0  # [s] of waiting, on a machine that others use


def wait_for(condition: Callable[[], bool]) -> bool:
    """Tell whether a condition comes true in time."""
    until = time.monotonic() + _LONGEST
    while not condition():
        if time.monotonic() > until:
            return False
        time.sleep(0.05)
    return True


def processes_of(group: int) -> list[int]:
    """Return the processes of a group that have not ended."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            state, _, number = (entry / "stat").read_text().rpartition(")")[2].split()[:3]
        except OSError:  # it has ended meanwhile
            continue
        if int(number) == group and state != "Z":
            found.append(int(entry.name))
    return found


def hear_interrupts() -> None:
    """Undo what a shell does to commands in the background: they ignore Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def command(name: str, settings: list[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start a command as a group of processes; none of it is left in the end."""
    if not Path("/proc/self/stat").exists():
        pytest.skip("processes are listed in /proc, which this system lacks")
    with log.open("wb") as file:
        arguments = [sys.executable, str(HOME / f"{name}.py"), *settings]
        running = subprocess.Popen(
            arguments, cwd=HOME, stdout=file, stderr=file, start_new_session=True,
            preexec_fn=hear_interrupts,
        )  # fmt: skip
        try:
            yield running
        finally:
            if processes_of(running.pid):
                os.killpg(running.pid, signal.SIGKILL)
            running.wait()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_training_whose_loaders_are_told_too_writes_its_checkpoint(
    number: signal.Signals, tiny_scenes: Path, tmp_path: Path
) -> None:
    run, log = tmp_path / "run", tmp_path / "log"
    settings = [*TINY, f"data.root={tiny_scenes}", "model=cnn_patch", "callbacks=checkpoints"]
    settings += ["trainer.max_steps=100000", "trainer.val_check_interval=2", "data.workers=2"]
    with command("train", [*settings, f"out={run}"], log) as training:
        assert wait_for(lambda: (run / "checkpoints" / "best.ckpt").is_file()), log.read_text()
        assert len(processes_of(training.pid)) >= 3
        os.killpg(training.pid, number)
        assert training.wait(_LONGEST) == 128 + number
        assert wait_for(lambda: not processes_of(training.pid))
    lines = log.read_text()
    assert "Traceback" not in lines
    told = next(json.loads(line) for line in lines.splitlines() if '"stopped"' in line)
    last = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    assert last["global_step"] == told["step"]
    assert lines.rstrip().endswith(f"train: stopped by {number.name}")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "status"),
    [(signal.SIGTERM, 143), (signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)],
)
def test_processes_that_render_end_with_their_command(
    number: signal.Signals, status: int, tmp_path: Path
) -> None:
    out, log = tmp_path / "scenes", tmp_path / "log"
    settings = ["object=carton", f"out={out}", "frames=4000", "size=[160,120]", "workers=2"]
    with command("generate", [*settings, "console=json"], log) as generating:
        assert wait_for(lambda: any(out.rglob("*.depth.png"))), log.read_text()
        os.kill(generating.pid, number)  # it alone
        assert generating.wait(_LONGEST) == status
        assert wait_for(lambda: not processes_of(generating.pid))
    assert "Traceback" not in log.read_text()


def test_a_worker_survives_the_first_sigterm_and_ends_at_the_second() -> None:
    script = (
        "import os, signal, sys, time\n"
        "from posefilter.signals import leave_signals_to_parent\n"
        "leave_signals_to_parent(0)\n"
        "print('ready', flush=True)\n"
        "while True: time.sleep(0.01); print('alive', flush=True)\n"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE) as worker:
        assert worker.stdout is not None
        assert worker.stdout.readline() == b"ready\n"
        for number in (signal.SIGINT, signal.SIGTERM):
            worker.send_signal(number)
            for _ in range(20):
                assert worker.stdout.readline() == b"alive\n"
        worker.send_signal(signal.SIGTERM)
        assert worker.wait(_LONGEST) == -signal.SIGTERM
