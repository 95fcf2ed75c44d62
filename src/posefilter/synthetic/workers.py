"""Render frames in several processes."""

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import torch
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from posefilter.errors import UserError
from posefilter.meshes.store import MeshStore
from posefilter.progress import bars
from posefilter.signals import end_with_parent
from posefilter.synthetic.frame_renderer import FrameRenderer, Job

FRAMES_PER_TASK = 5


def render_frames(
    job: Job, out: Path, frames: Sequence[int], workers: int, progress: bool, store: MeshStore
) -> None:
    """Render frames, in this process or in several.

    Args:
        job: What to render.
        out: The dataset's folder.
        frames: Numbers of the frames.
        workers: Processes.
        progress: Draw a bar.
        store: The job's meshes.
    """
    chunks: dict[tuple[int, int], list[int]] = {}
    for i in frames:
        chunks.setdefault((i // job.frames_per_scene, i // FRAMES_PER_TASK), []).append(i)
    columns = (
        TextColumn("rendering"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[rate]}"),
    )
    with bars(*columns, shown=progress) as bar:
        task = bar.add_task("frames", total=len(frames), rate="")
        began, done = time.perf_counter(), 0
        for count in _render_chunks(job, out, list(chunks.values()), workers, store):
            done += count
            rate = done / (time.perf_counter() - began)
            bar.update(task, completed=done, rate=f"{rate:.1f} frames/s")


def _render_chunks(
    job: Job, out: Path, chunks: list[list[int]], workers: int, store: MeshStore
) -> Iterator[int]:
    """Yield how many frames each chunk had, as they finish."""
    if workers == 1 or len(chunks) <= 1:
        renderer = FrameRenderer(job, out, store)
        for chunk in chunks:
            for frame in chunk:
                renderer.write(frame)
            yield len(chunk)
        return
    context = multiprocessing.get_context("spawn")
    with _single_threaded_children():
        pool = ProcessPoolExecutor(min(workers, len(chunks)), context, _start_worker, (job, out))
        with pool:
            with _main_left_alone():
                futures = [pool.submit(_render_chunk, chunk) for chunk in chunks]
            try:
                for future in as_completed(futures):
                    yield future.result()
            except BrokenProcessPool as error:
                raise UserError(
                    f"workers={workers}: the system has ended a process that rendered (was it out "
                    f"of memory?); take fewer, and type the command again: it resumes"
                ) from error
            finally:
                pool.shutdown(cancel_futures=True)


_frame_renderer: FrameRenderer | None = None  # one a worker process


def _start_worker(job: Job, out: Path) -> None:
    """Set up a worker process. It leaves Ctrl-C, which reaches it too, to its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    global _frame_renderer
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    _frame_renderer = FrameRenderer(job, out)


def _render_chunk(chunk: list[int]) -> int:
    """Render some frames in a worker."""
    assert _frame_renderer is not None
    for frame in chunk:
        _frame_renderer.write(frame)
    return len(chunk)


@contextmanager
def _main_left_alone() -> Iterator[None]:
    """Let processes that start meanwhile not run the user's script once more, as spawned ones do:
    what renders is all in this package, and a script that is not under `if __name__ ==
    "__main__":` would render in each of them, and wait for the lock on the folder.
    """
    main = sys.modules["__main__"]
    names = [name for name in ("__file__", "__spec__") if name in main.__dict__]
    hidden: dict[str, Any] = {name: main.__dict__.pop(name) for name in names}
    main.__spec__ = None
    try:
        yield
    finally:
        main.__dict__.update(hidden)


@contextmanager
def _single_threaded_children() -> Iterator[None]:
    """Let processes that start meanwhile compute with one thread each: more would compete."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ[name] for name in names if name in os.environ}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name in names:
            os.environ.pop(name, None)
        os.environ.update(before)
