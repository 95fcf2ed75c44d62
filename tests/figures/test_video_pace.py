"""A GIF plays at its video's speed, whatever the frames a second."""

from pathlib import Path

import numpy as np
import pytest

from posefilter.figures.video import VideoWriter, pace_gif


@pytest.mark.parametrize("fps", [1, 7.5, 24, 25, 30, 50, 60, 120, 1000])
def test_a_gif_lasts_as_long_as_its_video(fps: float) -> None:
    count = 300
    shown, waits = pace_gif(count, fps)
    assert sum(waits) == pytest.approx(1000 * count / fps, abs=15)
    # a browser shows for a tenth of a second what is to take less than two hundredths
    assert min(waits) >= 20
    assert all(wait % 10 == 0 for wait in waits)
    assert sorted(set(shown)) == shown
    assert len(shown) == count or fps > 50


def test_a_single_picture_is_shown() -> None:
    assert pace_gif(1, 100) == ([0], [20])


def test_later_pictures_are_not_squeezed(tmp_path: Path) -> None:
    """A legend that grows or shrinks leaves what is above it as it is."""
    photograph = np.random.default_rng(0).integers(256, size=(40, 64, 3), dtype=np.uint8)
    with VideoWriter(tmp_path / "video", "gif", 10) as writer:
        for rows in (20, 6, 34):
            writer.add(np.concatenate([photograph, np.full((rows, 64, 3), 100, np.uint8)]))
        first, lower, higher = writer._pictures
    assert first.shape == lower.shape == higher.shape == (60, 64, 3)
    assert all((one[:40] == photograph).all() for one in (first, lower, higher))
    assert (lower[46:] == 255).all()
