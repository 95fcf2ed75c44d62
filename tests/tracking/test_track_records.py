"""The figures of a track's rows."""

import weakref
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.tracking.toy import DEPTH, RGB, K, make_toy

from posefilter.cli.track import list_figures
from posefilter.tracking import records
from posefilter.tracking.records import TrackRow, compute_figures
from posefilter.tracking.tracker import Tracker


def make_row(x: float, truth: bool = True, tracked: bool = True) -> TrackRow:
    """Return a row whose pose is x meters off."""
    pose = np.eye(4)
    pose[:3, 3] = x, 0, 1
    result: Any = SimpleNamespace(
        is_tracked=tracked, pose=pose, seconds=0.1, status="tracked" if tracked else "lost"
    )
    real = np.eye(4)
    real[2, 3] = 1
    return TrackRow("v", "1", 0, 1, 1, result, 0.1, real if truth else None, x, x)


def test_jitter_is_of_frames_that_follow_each_other() -> None:
    """The object left between the second row and the third, and was found anew."""
    model = make_toy()[0].object_model
    away = make_row(0.0, truth=False, tracked=False)
    rows = [make_row(0.0), make_row(0.001), away, make_row(0.009), make_row(0.01)]
    assert compute_figures(rows, model)["jitter_mm"] == pytest.approx(1)


def test_rows_of_a_long_video_keep_no_belief() -> None:
    result = Tracker(make_toy()[1]).update(RGB, DEPTH, K)
    row = records.make_row("v", "1", (0, 1, 1), result, 0.1, None)
    wanted = np.sqrt(np.diag(result.covariance)).tolist()
    assert records.describe_row(row)["standard_deviations"] == wanted
    doubted = records.summarize_result(replace(result, blank="it is black"))
    assert records.describe_row(row._replace(result=doubted))["verdict"] == "unsure"
    belief = weakref.ref(result.belief)
    del result
    assert belief() is None


def test_the_time_of_an_object_is_not_shown_as_that_of_the_frame() -> None:
    """Other objects take theirs."""
    figures = compute_figures([make_row(0.0), make_row(0.001)], make_toy()[0].object_model)
    assert list_figures(figures)[-1] == ("its part of a frame", "100 ms")
