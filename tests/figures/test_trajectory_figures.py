"""Trajectories and glimpses: lines end where particles end, frames tell who is on the object."""

from typing import Any

import numpy as np
import pytest

from posefilter.figures.layout import draw_legend, draw_text
from posefilter.figures.trajectories import (
    OFF,
    ON,
    START,
    draw_glimpses,
    draw_trajectories,
    enlarge,
    find_hits,
)

MASK = np.zeros((40, 60), bool)
MASK[10:25, 20:45] = True
RGB = np.full((40, 60, 3), 50, np.uint8)
FIRST = np.array([[2.0, 3.0], [50.0, 35.0], [30.0, 15.0]])
LAST = np.array([[30.0, 20.0], [58.0, 38.0], [30.0, 15.0]])
STATES = np.stack([FIRST + s * (LAST - FIRST) for s in np.linspace(0, 1, 5)])


def places(picture: np.ndarray, color: tuple[int, int, int], rows: slice) -> np.ndarray:
    return np.argwhere((picture[rows] == color).all(-1))


def test_which_particles_are_on_the_mask() -> None:
    assert find_hits(MASK, LAST).tolist() == [True, False, True]
    assert find_hits(MASK, STATES).shape == (5, 3)
    assert not find_hits(MASK, np.array([[1e9, np.nan], [-5.0, 12.0]])).any()


def test_ends_are_green_on_the_object_and_red_off_it() -> None:
    picture = draw_trajectories(RGB, MASK, STATES, "trajectories")
    top = (
        len(picture)
        - 400
        - len(draw_legend([("start", START), ("on the object", ON), ("off it", OFF)]))
    )
    at = lambda u, v: picture[top + round((v + 0.5) * 10), round((u + 0.5) * 10)]  # noqa: E731
    assert tuple(at(30, 20)) == ON
    assert tuple(at(58, 38)) == OFF
    assert tuple(at(2, 3)) == START


def test_the_frame_grows_where_particles_leave_it() -> None:
    inside = draw_trajectories(RGB, MASK, STATES, "trajectories")
    outside = draw_trajectories(RGB, MASK, STATES - 100, "trajectories")
    gray = (outside == 200).all(-1).sum()
    assert (inside == 200).all(-1).sum() < 50
    assert gray > 0.6 * 600 * 400


def test_glimpses_are_shown_whole_and_framed_by_where_they_were() -> None:
    patches = np.zeros((5, 3, 3, 3, 3), np.uint8)
    patches[2, 1, 0, 2] = (10, 20, 250)  # a sample of particle 1 at step 2: top right
    figure = draw_glimpses(RGB, MASK, STATES, patches, "glimpses")
    blue = places(figure, (10, 20, 250), slice(None))
    assert 25 * 25 < len(blue) < 28 * 28  # a third of a cell
    row, column = blue.mean(0)
    cell = figure[int(row) - 20 : int(row) + 80, int(column) - 80 : int(column) + 20]
    assert (cell == OFF).all(-1).any()  # at step 2 it is off the object
    on = np.array([find_hits(MASK, s) for s in STATES]).sum()
    table = figure[-3 * 90 :]
    assert abs((table == ON).all(-1).sum() / ((table == OFF).all(-1).sum()) - on / (15 - on)) < 0.25


def test_enlarging_repeats_samples() -> None:
    patch = np.arange(4, dtype=np.uint8).reshape(2, 2, 1).repeat(3, 2)
    assert enlarge(patch, 6)[..., 0].tolist() == [[0, 0, 0, 1, 1, 1]] * 3 + [[2, 2, 2, 3, 3, 3]] * 3


def test_the_share_on_the_object_is_of_all_particles(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not of those that are drawn, which are evenly chosen."""
    notes: list[str] = []

    def note(text: str, *rest: Any, **more: Any) -> np.ndarray:
        notes.append(text)
        return draw_text(text, *rest, **more)

    monkeypatch.setattr("posefilter.figures.trajectories.draw_text", note)
    states = np.concatenate([STATES[:, [0] * 100], STATES[:, [1] * 300]], axis=1)
    picture = draw_trajectories(RGB, MASK, states, "trajectories")
    assert "5 steps: 25% end on the object" in notes
    above_legend = slice(0, len(picture) - len(draw_legend([("start", START)])))
    for color in (ON, OFF):
        assert len(places(picture, color, above_legend))
