"""The cost bench: exponents of planted curves, and the encoder told apart from the filter."""

from collections.abc import Callable
from types import ModuleType

import numpy as np
import pytest


@pytest.fixture(scope="module")
def cost(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("bench/cost.py")


def test_exponents_are_those_of_planted_curves(cost: ModuleType) -> None:
    values = (10, 100, 1000)
    for power in (0.0, 1.0, 1.7):
        assert cost.fit_exponent(values, [3 * v**power for v in values]) == pytest.approx(power)
    took = [[cost.Cost(0.1, 0.001 * v + 0.05)] * 5 for v in (160, 320, 640, 960)]
    cells = cost.describe("toy", "width", (160, 320, 640, 960), took).split(" | ")
    ratio, exponent = (0.96 + 0.05) / (0.16 + 0.05), np.log(1.01 / 0.69) / np.log(1.5)
    assert float(cells[5]) == pytest.approx(ratio, abs=0.01)
    assert float(cells[7]) == pytest.approx(exponent, abs=0.01)
    assert cells[8:10] == ["100", "100"]
    assert [cost.show_milliseconds(one) for one in (2.0941, 0.012345)] == ["2,090", "12.3"]


def test_what_is_measured_is_what_was_asked_for(cost: ModuleType) -> None:
    method = cost.make_method("patch_pf")
    few, many = (
        min(cost.measure(method, cost.draw_image(160), n, 2, 64).filter for _ in range(2))
        for n in (10, 4000)
    )
    assert many > 3 * few
    assert (method.filter.particles, method.filter.steps) == (4000, 2)
    assert "encode" not in vars(method)


def test_headings_are_the_columns_of_a_row(cost: ModuleType) -> None:
    for key, values in cost.SWEEPS.items():
        took = [[cost.Cost(0.1, 0.05)] * 5 for _ in values]
        line = cost.describe("toy", key, values, took)
        assert line.count(" | ") + 1 == len(cost.make_head(key))
