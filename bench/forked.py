"""What a forked process does, whatever it is for; nothing of the project is imported here."""

import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn


def end_with(work: Callable[[], int], otherwise: int) -> NoReturn:
    """Do what a forked process has to do, and end it with the status that it returns.

    Args:
        work: Returns the exit status, or raises SystemExit.
        otherwise: The status where it ends in another exception, whose traceback is printed.
    """
    status = otherwise
    try:
        status = work()
    except SystemExit as asked:
        status = asked.code if isinstance(asked.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def leave(work: Callable[[], int], limit: int | None, log: Path = Path(os.devnull)) -> None:
    """Do what a forked process has to do, and end it; what it prints goes into a file."""

    def begin() -> int:
        os.setsid()
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        sys.stdout = sys.stderr = log.open("w")
        for stream in (1, 2):
            os.dup2(sys.stdout.fileno(), stream)
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
        return work()

    end_with(begin, 1)


def wait(number: int, seconds: float) -> int | None:
    """Return a process's exit status, minus a signal's number; None where it was killed here."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        done, code = os.waitpid(number, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(code)
        time.sleep(0.02)
    os.kill(number, signal.SIGKILL)
    os.waitpid(number, 0)
    return None
