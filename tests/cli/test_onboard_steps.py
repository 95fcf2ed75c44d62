"""The number of steps of an onboarding fills the time that there is, whatever was measured."""

import pytest

from posefilter.cli.onboard import choose_steps


@pytest.mark.parametrize("step", [0.05, 0.3, 0.4, 4.0])
def test_all_of_the_time_is_used(step: float) -> None:
    steps, seconds = choose_steps(600.0, step)
    assert steps * seconds == pytest.approx(600.0)
    # of a machine that was busy while it was measured, most of the time would be left unused
    assert 600.0 / steps <= max(0.4, 600.0 / 8000)


def test_a_slow_measure_does_not_shorten_the_training() -> None:
    assert choose_steps(600.0, 4.0) == choose_steps(600.0, 0.4)


def test_some_steps_are_taken_even_if_no_time_is_left() -> None:
    assert choose_steps(-5.0, 0.5) == (100, 0.5)
