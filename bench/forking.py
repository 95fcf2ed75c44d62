"""Run commands in processes that are forked from one that has imported everything: torch's import
takes seconds, a fork takes a few hundredths.
"""

import gc
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import NamedTuple

import cv2
import omegaconf._utils
import torch
import yaml
from forked import end_with
from programs import HOME

# what the commands import when they are called: before the fork, so that it is paid once
import posefilter.cli.calibrate
import posefilter.cli.check_data
import posefilter.cli.convert_bag
import posefilter.cli.evaluate
import posefilter.cli.export
import posefilter.cli.generate
import posefilter.cli.onboard
import posefilter.cli.predict
import posefilter.cli.report
import posefilter.cli.track
import posefilter.cli.train  # noqa: F401
from posefilter.cli.command import run_command

RAW = 70  # exit status of a process whose command ended in a traceback
_WARM: set[tuple[str, ...]] = set()  # what was run in this process


class Ended(NamedTuple):
    """How a process ended."""

    status: int | None  # its exit status, minus a signal's number; None: it took too long
    seconds: float
    cpu: float  # of its own processor time [s]
    out: str
    err: str


def prepare() -> None:
    """Have no threads in this process, which a forked one would miss, and parse settings by
    libyaml, where there is one: that is a third of what a refusal takes.
    """
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    if yaml.__with_libyaml__:
        pure, yaml.SafeLoader = yaml.SafeLoader, yaml.CSafeLoader  # type: ignore[misc]
        loader = omegaconf._utils.get_yaml_loader()
        yaml.SafeLoader = pure  # type: ignore[misc]
        omegaconf._utils.get_yaml_loader = lambda: loader


def warm(lines: Mapping[str, Sequence[str]]) -> None:
    """Run commands in this process, each once, so that what they import and keep is paid once; what
    is there afterwards is not looked at by a forked process's garbage collection.

    Args:
        lines: What is typed after each command's name; each must work.
    """
    with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):
        for command, arguments in lines.items():
            typed = (command, *(one for one in arguments if not one.startswith("out=")))
            if typed not in _WARM:
                assert run_command(command, HOME, list(arguments)) == 0, command
                _WARM.add(typed)
    gc.collect()
    gc.freeze()


def start(
    command: str, arguments: Sequence[str], log: Path, before: Callable[[], None] | None = None
) -> int:
    """Start a command in a forked process.

    Args:
        command: Its name.
        arguments: What is typed after it.
        log: Gets what it prints, in `<log>.out` and `<log>.err`.
        before: Called first, in the new process.

    Returns:
        The process's number.
    """

    def begin() -> int:
        os.setsid()
        for name, stream in (("out", 1), ("err", 2)):
            file = os.open(f"{log}.{name}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(file, stream)
        # what else may stand here, as pytest's capture, writes to files of its own
        sys.stdout, sys.stderr = (os.fdopen(n, "w", 1, closefd=False) for n in (1, 2))
        if before is not None:
            before()
        return run_command(command, HOME, list(arguments))

    sys.stdout.flush()
    sys.stderr.flush()
    number = os.fork()
    if not number:
        end_with(begin, RAW)
    return number


def wait(number: int, log: Path, seconds: float) -> Ended:
    """Wait for a process, and kill it where it takes longer."""
    began = time.monotonic()
    status: int | None = None
    while True:
        done, code, used = os.wait4(number, os.WNOHANG)
        spent = time.monotonic() - began
        if done:
            status = os.waitstatus_to_exitcode(code)
            break
        if spent > seconds:
            os.kill(number, signal.SIGKILL)
            _, _, used = os.wait4(number, 0)
            break
        time.sleep(min(0.02, seconds))
    texts = [Path(f"{log}.{name}") for name in ("out", "err")]
    out, err = (t.read_text(errors="replace") if t.is_file() else "" for t in texts)
    return Ended(status, spent, used.ru_utime + used.ru_stime, out, err)


def run(
    command: str,
    arguments: Sequence[str],
    log: Path,
    seconds: float = 600,
    before: Callable[[], None] | None = None,
) -> Ended:
    """Run a command in a forked process; see `start` and `wait`."""
    return wait(start(command, arguments, log, before), log, seconds)
