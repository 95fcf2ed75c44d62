"""Signals that end a command, and those that its worker processes leave to it."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from posefilter.errors import Stopped


@contextmanager
def stopped_by_sigterm() -> Iterator[None]:
    """Raise Stopped at a SIGTERM, so that it ends as Ctrl-C does: what is open is closed."""

    def stop(number: int, _: FrameType | None) -> None:
        raise Stopped(number)

    if threading.current_thread() is not threading.main_thread():  # which alone gets signals
        yield
        return
    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def leave_signals_to_parent(_: int = 0) -> None:
    """Have this worker process go on at Ctrl-C and at a first SIGTERM.

    A terminal, a job scheduler or a service manager sends these to all processes of a command. The
    parent decides what is still to be done, and ends its workers itself. A second SIGTERM ends the
    worker: it is the parent's, or there is no parent any more.

    Args:
        _: The worker's number, which torch's data loader passes.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, _: signal.signal(number, signal.SIG_DFL))


def end_with_parent() -> None:
    """End this worker process as soon as its parent has ended, however that did."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
