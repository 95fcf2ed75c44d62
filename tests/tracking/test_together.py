"""Several objects tracked at once: they share a frame, take turns, and do not change each other."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from tests.tracking.toy import DEPTH, RGB, K, Toy, make_toy, walk_pose

import posefilter
from posefilter.errors import UserError
from posefilter.images import Images
from posefilter.tracking.frame import Frame
from posefilter.tracking.settings import TrackerSettings


@pytest.fixture(autouse=True)
def _keep_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def follow(threads: int | None, frames: int = 12) -> list[list[posefilter.TrackResult]]:
    """Track three objects, of which the second goes away for a while."""
    toys = [make_toy() for _ in range(3)]
    tracker = posefilter.Tracker([estimator for _, estimator in toys], seed=3, threads=threads)
    out = []
    for number, pose in enumerate(walk_pose(frames)):
        for k, (toy, _) in enumerate(toys):
            toy.truth = None if k == 1 and 4 <= number < 8 else pose
        out.append(tracker.update_all(RGB, DEPTH, K))
    return out


@pytest.mark.parametrize("threads", [2, 3, 4])
def test_objects_side_by_side_are_where_they_are_one_after_the_other(threads: int) -> None:
    torch.set_num_threads(1)
    alone, together = follow(None), follow(threads)
    for before, after in zip(alone, together, strict=True):
        assert [one.status for one in after] == [one.status for one in before]
        for one, other in zip(before, after, strict=True):
            np.testing.assert_allclose(other.pose, one.pose, atol=1e-6)
            assert other.presence == pytest.approx(one.presence, abs=1e-6)
    assert "lost" in {results[1].status for results in together}
    assert together[-1][1].found


def test_an_error_of_one_object_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    toys = [make_toy() for _ in range(2)]
    for toy, _ in toys:
        toy.truth = walk_pose(1)[0]
    tracker = posefilter.Tracker([estimator for _, estimator in toys], threads=2)
    tracker.update_all(RGB, DEPTH, K)

    def fail(batch: object) -> None:
        raise ValueError("no")

    monkeypatch.setattr(toys[1][0], "encode", fail)
    with pytest.raises(ValueError, match="no"):
        tracker.update_all(RGB, DEPTH, K)


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


def test_lost_objects_take_turns_to_be_searched_for(monkeypatch: pytest.MonkeyPatch) -> None:
    toys = [make_toy() for _ in range(5)]
    searched: list[Toy] = []
    for toy, _ in toys:
        filter = toy.filter.forward

        def search(*given: object, toy: Toy = toy, filter: object = filter) -> object:
            searched.append(toy)
            return filter(*given)  # type: ignore[operator]

        monkeypatch.setattr(toy.filter, "forward", search)
    tracker = posefilter.Tracker([estimator for _, estimator in toys])
    counts = []
    for _ in range(16):
        searched.clear()
        tracker.update_all(RGB, DEPTH, K)
        counts.append(len(searched))
        assert len(set(map(id, searched))) == len(searched)
    assert counts[0] == 5
    assert counts[1:] == 15 * [1]


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
