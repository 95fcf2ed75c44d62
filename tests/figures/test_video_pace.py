"""A GIF plays at its video's speed, whatever the frames a second."""

import pytest

from posefilter.figures.video import pace_gif


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
