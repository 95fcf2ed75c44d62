"""Several objects tracked at once: they share a frame, take turns, and do not change each other."""

import os
import pickle
import signal
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tests.tracking.toy import DEPTH, RGB, K, SeeingToy, Toy, make_toy, walk_pose
from torch import Tensor

import posefilter
from posefilter.errors import UserError
from posefilter.estimator import Estimator
from posefilter.images import Images
from posefilter.tracking.processes import WorkerProcess, share_out
from posefilter.tracking.settings import TrackerSettings
from posefilter.tracking.window import Frame
from posefilter.tracking.worker import Start
from posefilter.types import Batch


@pytest.fixture(autouse=True)
def _keep_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


FRAMES = 12


class Failing(SeeingToy):
    """It fails at a frame, or ends its process there if that is not the one that it was made in."""

    def __init__(self, poses: list[Tensor | None], number: int, error: Exception | None) -> None:
        super().__init__(poses)
        self.number, self.error, self.home = number, error, os.getpid()

    def encode(self, batch: Batch) -> Any:
        if round(255 * float(batch.rgb[:, 1].mean())) == self.number:
            if self.error is not None:
                raise self.error
            if os.getpid() != self.home:
                os.kill(os.getpid(), signal.SIGKILL)
        return super().encode(batch)


def make_poses(away: range = range(0)) -> list[Tensor | None]:
    """Return the poses of an object that is not there for a while."""
    return [None if n in away else pose for n, pose in enumerate(walk_pose(FRAMES))]


def make_tracker(toys: Sequence[Toy], threads: int | None = None) -> posefilter.Tracker:
    tracker = posefilter.Tracker([Estimator([t], "cpu") for t in toys], seed=3, threads=threads)
    tracker.wait()
    return tracker


def follow(
    tracker: posefilter.Tracker, frames: Iterable[int] = range(FRAMES)
) -> list[list[posefilter.TrackResult]]:
    """Return what comes of frames, whose green is their number."""
    green = np.array([0, 1, 0], np.uint8)
    return [tracker.update_all(RGB + np.uint8(number) * green, DEPTH, K) for number in frames]


def check_same(
    before: list[list[posefilter.TrackResult]], after: list[list[posefilter.TrackResult]]
) -> None:
    for frame, other in zip(before, after, strict=True):
        assert [one.status for one in other] == [one.status for one in frame]
        for one, two in zip(frame, other, strict=True):
            np.testing.assert_array_equal(two.pose, one.pose)
            np.testing.assert_array_equal(two.belief.samples, one.belief.samples)
            assert two.presence == one.presence
            assert two.object_model.name == one.object_model.name


@pytest.mark.parametrize("threads", [2, 3, 4])
@pytest.mark.slow
def test_objects_side_by_side_are_where_they_are_one_after_the_other(threads: int) -> None:
    torch.set_num_threads(1)
    toys = [SeeingToy(make_poses()), SeeingToy(make_poses(range(4, 8))), SeeingToy(make_poses())]
    alone = follow(make_tracker(toys))
    tracker = make_tracker(toys, threads)
    together = follow(tracker)
    check_same(alone, together)
    assert "lost" in {results[1].status for results in together}
    assert together[-1][1].is_tracked
    tracker.reset()
    check_same(alone, follow(tracker))
    tracker.close()
    tracker.reset()
    check_same(alone, follow(tracker))


def test_an_error_of_one_object_is_raised_and_the_others_go_on() -> None:
    toys = [SeeingToy(make_poses()), Failing(make_poses(), 3, ValueError("no"))]
    tracker = make_tracker(toys, 2)
    follow(tracker, range(3))
    for _ in range(2):
        with pytest.raises(ValueError, match="no"):
            follow(tracker, [3])
    assert all(result.is_tracked for result in follow(tracker, [4])[0])


@pytest.mark.slow
def test_nothing_is_lost_with_a_process_that_ends() -> None:
    toys = [Failing(make_poses(), 5, None) for _ in range(2)]
    alone = follow(make_tracker(toys))
    tracker = make_tracker(toys, 2)
    check_same(alone[:5], follow(tracker, range(5)))
    check_same(alone[5:6], follow(tracker, [5]))
    before = tracker._others.workers[0]  # type: ignore[union-attr]
    assert before._process.wait(10) == -signal.SIGKILL
    check_same(alone[6:8], follow(tracker, [6, 7]))
    tracker.wait()
    assert tracker._others.workers[0] is not before  # type: ignore[union-attr]
    check_same(alone[8:], follow(tracker, range(8, FRAMES)))


def test_an_interrupted_frame_leaves_no_answer_for_the_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As in a notebook: the cell is interrupted while it waits, and run again."""
    here, away = SeeingToy(make_poses()), SeeingToy(make_poses(range(FRAMES)))
    with make_tracker([here, away], 2) as tracker:
        follow(tracker, range(3))
        worker = tracker._others.workers[0]  # type: ignore[union-attr]

        def interrupt(self: object) -> None:
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(type(worker), "receive", interrupt)
            with pytest.raises(KeyboardInterrupt):
                follow(tracker, [3])
        assert worker._process.poll() is not None
        for number in (3, 4):
            assert [one.is_tracked for one in follow(tracker, [number])[0]] == [True, False]
        tracker.wait()
        for number in (5, 6, 7):
            assert [one.is_tracked for one in follow(tracker, [number])[0]] == [True, False]


def test_a_process_that_ends_again_and_again_is_told() -> None:
    tracker = make_tracker([SeeingToy(make_poses()) for _ in range(2)], 2)
    others = tracker._others
    assert others is not None
    others._restarts = 0
    others.workers[0]._process.kill()
    others.workers[0]._process.wait()
    with pytest.raises(UserError, match="ended 11 times"):
        follow(tracker, [0])


def test_a_method_that_cannot_be_sent_is_refused() -> None:
    toys = [SeeingToy(make_poses()) for _ in range(2)]
    toys[1].told = lambda: None  # type: ignore[assignment]
    with pytest.raises(UserError, match="threads=: toy, toy cannot be tracked in several"):
        make_tracker(toys, 2)


def test_a_process_that_cannot_start_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    class Here(SeeingToy):
        """It is defined in a function, where no other process finds it."""

    Here.__qualname__ = "Here"
    with monkeypatch.context() as here:
        here.setattr(sys.modules[__name__], "Here", Here, raising=False)
        tracker = make_tracker([Here(make_poses()) for _ in range(2)], 2)
    with pytest.raises(UserError, match="could not start"):
        follow(tracker, [0])


def test_a_process_that_starts_leaves_ctrl_c_to_the_first_one() -> None:
    """Importing torch takes it seconds, in which Ctrl-C must not end it with a traceback."""
    worker = WorkerProcess(pickle.dumps(Start((), 1)), 1)
    status = Path(f"/proc/{worker._process.pid}/status")
    ignored = 0
    while not ignored and not worker.ready:
        (line,) = [one for one in status.read_text().splitlines() if one.startswith("SigIgn:")]
        ignored = int(line.split()[1], 16) >> (signal.SIGINT - 1) & 1
        time.sleep(0.01)
    assert not worker.ready  # long before it is
    worker.close()


def test_work_is_shared_out_evenly() -> None:
    assert share_out([1, 1, 1, 1], 2) == [[0, 2], [1, 3]]
    assert share_out([1, 1, 8, 1.5], 2) == [[2], [3, 0, 1]]
    assert share_out([1, 1], 1) == [[0, 1]]


def test_objects_take_turns_to_see_the_whole_image() -> None:
    toys = [make_toy() for _ in range(4)]
    settings = TrackerSettings(whole_image_every=4, window_side=64)
    tracker = posefilter.Tracker([estimator for _, estimator in toys], settings)
    for number, pose in enumerate(walk_pose(13, shift=0.0, turn=0.0)):
        for toy, _ in toys:
            toy.truth = pose
            toy.encoded.clear()
        tracker.update_all(RGB, DEPTH, K)
        whole = [(120, 160) in toy.encoded for toy, _ in toys]
        assert sum(whole) == (1 if number else 4)
        assert number == 0 or whole[-number % 4]


def test_lost_objects_take_turns_to_be_searched_for() -> None:
    """Every second frame is probed for each, and every third of these searched in six steps."""
    toys = [make_toy() for _ in range(3)]
    tracker = posefilter.Tracker([estimator for _, estimator in toys])
    for number in range(16):
        for toy, _ in toys:
            toy.scored.clear()
        tracker.update_all(RGB, DEPTH, K)
        if number:
            counts = [number + phase for phase in range(3)]
            assert [len(toy.scored) > 0 for toy, _ in toys] == [count % 2 == 0 for count in counts]
            assert [len(toy.scored) > 2 for toy, _ in toys] == [count % 6 == 0 for count in counts]


def test_a_search_costs_a_bounded_number_of_points() -> None:
    """And none where a probe shows nothing; where it shows the object, it follows at once."""
    toy, estimator = make_toy()
    tracker = posefilter.Tracker(estimator, TrackerSettings(search_every=0))
    costs = []
    for number in range(6):
        toy.truth = None if number < 5 else walk_pose(1)[0]
        toy.scored.clear()
        result = tracker.update(RGB, DEPTH, K)
        costs.append(sum(toy.scored))
    assert max(costs[1:5]) < 5_000
    assert result.status == "started"
    assert 10_000 < costs[5] < 30_000 < costs[0]


def test_the_whole_image_is_prepared_once() -> None:
    frame = Frame(Images(RGB[None], DEPTH[None], K[None]))
    assert frame.see_whole((80, 60)) is frame.see_whole((80, 60))
    assert frame.see_whole((80, 60)).rgb.shape == (1, 3, 60, 80)
    assert frame.see_whole((None, None)).rgb.shape == (1, 3, 120, 160)


@pytest.mark.parametrize("threads", [0, -1, 1.5, True])
def test_threads_are_a_whole_number(threads: float) -> None:
    with pytest.raises(UserError, match="threads"):
        posefilter.Tracker(make_toy()[1], threads=threads)  # type: ignore[arg-type]


def test_what_remains_of_the_threads_an_operation_may_use() -> None:
    posefilter.Tracker([make_toy()[1] for _ in range(2)], threads=4)
    assert torch.get_num_threads() == 2
    posefilter.Tracker(make_toy()[1], threads=3)
    assert torch.get_num_threads() == 3
