"""A process that tracks objects for another one.

`main` reads pickles from its standard input and answers on its standard output, both pipes of the
process that started it (`posefilter.tracking.processes`). First comes a `Start`, which it answers
with None; then a `Task` for each frame, which it answers with a list of `Answer`. In place of an
answer it sends the exception that came instead. It ends when its input does.
"""

import os
import pickle
import sys
from typing import Any, NamedTuple

import torch

from posefilter.images import Images
from posefilter.memory import keep_freed_memory
from posefilter.tracking.track import Track, TrackResult, TrackSnapshot
from posefilter.tracking.window import Frame

_OF_METHOD = ("object_model", "calibration")  # attributes of a result that both processes have


class Start(NamedTuple):
    """What a process needs once."""

    tracks: tuple[Track, ...]
    threads: int  # that an operation may use


class Task(NamedTuple):
    """What it is to do in one frame."""

    images: Images
    snapshots: dict[int, TrackSnapshot]  # of the tracks that it is to update, by their number


class Answer(NamedTuple):
    """What became of one track."""

    snapshot: TrackSnapshot
    result: dict[str, Any]  # the attributes of a `TrackResult`, without what its method has


def update(track: Track, snapshot: TrackSnapshot, frame: Frame) -> Answer:
    """Update a track that was elsewhere in the last frame."""
    track.snapshot = snapshot
    content = vars(track.update(frame))
    return Answer(track.snapshot, {key: x for key, x in content.items() if key not in _OF_METHOD})


def restore(track: Track, answer: Answer) -> TrackResult:
    """Take over what another process made of a track."""
    track.snapshot = answer.snapshot
    calibration = track.method.calibration if answer.result["features"] else None
    return TrackResult(
        **answer.result, object_model=track.method.object_model, calibration=calibration
    )


def main() -> None:
    """Answer until the input ends."""
    # what is printed here must not end up between the answers
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    keep_freed_memory()
    tracks: tuple[Track, ...] = ()
    while True:
        answer: Any
        try:
            given = pickle.load(sys.stdin.buffer)
            if isinstance(given, Start):
                torch.set_num_threads(given.threads)
                tracks, answer = given.tracks, None
            else:
                frame = Frame(given.images)
                snapshots = given.snapshots.items()
                answer = [update(tracks[i], snapshot, frame) for i, snapshot in snapshots]
        except EOFError:
            return
        except Exception as error:
            answer = error
        try:
            content = pickle.dumps(answer, pickle.HIGHEST_PROTOCOL)
        except Exception:  # an exception may hold anything
            content = pickle.dumps(RuntimeError(f"{type(answer).__name__}: {answer}"))
        try:
            answers.write(content)
            answers.flush()
        except BrokenPipeError:  # the other process has ended
            os._exit(0)
