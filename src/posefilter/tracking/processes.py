"""Objects tracked side by side, by processes that have a core each.

Threads of one process would wait for each other: a tracked frame is some thousand small operations,
and between them Python runs one thread at a time.
"""

import contextlib
import os
import pickle
import subprocess
import sys
import threading
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from posefilter.errors import UserError
from posefilter.tracking.track import Track, TrackResult
from posefilter.tracking.window import Frame
from posefilter.tracking.worker import Start, Task, restore

_MOST_RESTARTS = 10  # of processes that ended
_PROGRAM = """
import signal
signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process decides what Ctrl-C ends
from posefilter.tracking.worker import main
main()
"""


class WorkerProcess:
    """One other process; it starts in the background, and can be asked once it is `ready`.

    Args:
        content: A pickled `Start`.
        threads: That an operation may use in it.
    """

    def __init__(self, content: bytes, threads: int) -> None:
        paths = [path or str(Path.cwd()) for path in sys.path]
        own = {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": str(threads)}
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=None if _has_stderr() else subprocess.DEVNULL,
            env=dict(os.environ) | own,
        )
        self._error: Exception | None = None
        self.close = weakref.finalize(self, _end, self._process)
        self._starting = threading.Thread(target=self._start, args=(content,), daemon=True)
        self._starting.start()

    def _start(self, content: bytes) -> None:
        try:
            self._send(content)
            self._error = self.receive()
        except (OSError, ValueError, EOFError) as error:  # it has ended
            self._error = error

    def wait(self) -> None:
        """Wait until it has started."""
        self._starting.join()

    @property
    def ready(self) -> bool:
        """Whether it can be asked.

        Raises:
            UserError: It could not start.
        """
        if self._starting.is_alive():
            return False
        if self._error is not None:
            raise UserError(
                f"threads=: a second process to track in could not start ({self._error!r}); "
                "leave threads out to track in one"
            )
        return True

    @property
    def ended(self) -> bool:
        """Whether it had started, and is no more."""
        started = not self._starting.is_alive() and self._error is None
        return started and self._process.poll() is not None

    def ask(self, task: Task) -> bool:
        """Give it something to do; tell whether it is still there."""
        try:
            self._send(pickle.dumps(task, pickle.HIGHEST_PROTOCOL))
        except OSError:
            return False
        return True

    def receive(self) -> Any:
        """Return its next answer.

        Raises:
            EOFError: It has ended.
        """
        assert self._process.stdout is not None
        try:
            return pickle.load(self._process.stdout)
        except pickle.UnpicklingError as error:  # it was ended while it wrote
            raise EOFError from error

    def _send(self, content: bytes) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(content)
        self._process.stdin.flush()


def _has_stderr() -> bool:
    try:
        os.fstat(2)
    except OSError:  # it was closed: its number would be given to something else
        return False
    return True


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()  # it holds nothing that could be lost
    process.wait()
    for pipe in (process.stdin, process.stdout):
        assert pipe is not None
        with contextlib.suppress(OSError):  # what was not sent is not needed any more
            pipe.close()


class MultiprocessTracker:
    """Tracks that this process and others update, a share of them each.

    A track's snapshot goes to the process that updates it and comes back with the answer, so that
    a frame's work can be shared out anew, and nothing is lost with a process. Until another
    process has started, this one does all by itself. One that ended is replaced.

    Args:
        tracks: What to update.
        processes: How many there are, this one included; 2 or more.
        threads: That an operation may use in each.

    Raises:
        UserError: A method cannot be sent to another process.
    """

    def __init__(self, tracks: Sequence[Track], processes: int, threads: int) -> None:
        self.tracks = tuple(tracks)
        try:
            content = pickle.dumps(Start(self.tracks, threads), pickle.HIGHEST_PROTOCOL)
        except Exception as error:  # what a method of one's own holds may be anything
            names = ", ".join(track.method.object_model.name for track in tracks)
            raise UserError(
                f"threads=: {names} cannot be tracked in several processes, since a method cannot "
                f"be pickled ({error}); leave threads out to track in one"
            ) from error
        self._content, self._threads, self._restarts = content, threads, _MOST_RESTARTS
        self.workers = [self._start() for _ in range(processes - 1)]

    def update(self, frame: Frame) -> list[TrackResult]:
        """Update all tracks with a frame."""
        self._replace_ended()
        ready = [worker for worker in self.workers if worker.ready]
        shares = share_out([track.estimated_cost for track in self.tracks], len(ready) + 1)
        out: dict[int, TrackResult] = {}
        asked: list[tuple[WorkerProcess, list[int]]] = []
        error: Exception | None = None
        try:
            for worker, share in zip(ready, shares[1:], strict=True):
                asked.append((worker, share))
                if not worker.ask(Task(frame.images, {i: self.tracks[i].snapshot for i in share})):
                    asked.pop()  # it has ended; its share is done below
            out |= {i: self.tracks[i].update(frame) for i in shares[0]}
            while asked:
                worker, share = asked[0]
                try:
                    answers = worker.receive()
                except EOFError:  # it has ended, likewise
                    answers = []
                asked.pop(0)
                if isinstance(answers, Exception):
                    error = answers
                elif answers:
                    pairs = zip(share, answers, strict=True)
                    out |= {i: restore(self.tracks[i], answer) for i, answer in pairs}
        finally:  # an answer that was not read would be taken for that of the next frame
            for worker, _ in asked:
                worker.close()
                self._restarts += 1  # it did not end by itself
        if error is not None:
            raise error
        out |= {i: self.tracks[i].update(frame) for i in range(len(self.tracks)) if i not in out}
        return [out[i] for i in range(len(self.tracks))]

    def _replace_ended(self) -> None:
        """Start a process anew in the place of one that has ended."""
        for number, worker in enumerate(self.workers):
            if worker.ended:
                if self._restarts == 0:
                    raise UserError(
                        f"threads=: processes that track objects ended {_MOST_RESTARTS + 1} times, "
                        "perhaps for want of memory; leave threads out to track in one"
                    )
                self._restarts -= 1
                self.workers[number] = self._start()

    def _start(self) -> WorkerProcess:
        return WorkerProcess(self._content, self._threads)

    def wait(self) -> None:
        """Wait until all processes have started."""
        for worker in self.workers:
            worker.wait()

    def close(self) -> None:
        """End the other processes."""
        for worker in self.workers:
            worker.close()
        self.workers = []


def share_out(costs: Sequence[float], processes: int) -> list[list[int]]:
    """Return which of the tracks each process updates: the longest first, each to the process
    that has the least to do (Graham 1969).
    """
    loads = [0.0] * processes
    shares: list[list[int]] = [[] for _ in range(processes)]
    for i in sorted(range(len(costs)), key=lambda i: -costs[i]):
        least = loads.index(min(loads))
        loads[least] += costs[i]
        shares[least].append(i)
    return shares
