"""What a run says of its own cost."""

import time

import pytest

from posefilter.cli.train import cost


def test_a_step_is_charged_with_this_starts_time_alone() -> None:
    told = cost(10, 4, time.perf_counter() - 30, time.process_time() - 12)
    assert told["steps"] == 10
    assert told["seconds_per_step"] == pytest.approx(5, abs=0.2)
    assert told["cpu_seconds_per_step"] == pytest.approx(2, abs=0.2)


def test_a_run_that_was_only_tested_again_has_no_cost() -> None:
    assert cost(10, 10, 0.0, 0.0) == {
        "steps": 10,
        "seconds_per_step": None,
        "cpu_seconds_per_step": None,
    }
