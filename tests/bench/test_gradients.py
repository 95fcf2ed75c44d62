"""The table of gradients: its measure, and its numbers as they are written."""

import math
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

HOME = Path(__file__).parents[2]


@pytest.fixture
def gradients(
    load_script: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch
) -> ModuleType:
    """Return bench/gradients.py, which imports its neighbor."""
    monkeypatch.syspath_prepend(str(HOME / "bench"))
    return load_script("bench/gradients.py")


def test_numbers_are_written_short(gradients) -> None:
    numbers = (1.0, 2.76, 29.4, 479.0, 98_700.0, 2.6e7, 1.9e20, math.inf, math.nan)
    wanted = ["1.0", "2.8", "29", "480", "99,000", "3e7", "2e20", "overflows", "overflows"]
    assert [gradients.written(number) for number in numbers] == wanted


def test_each_ablation_is_a_row_of_ratios(
    gradients, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(gradients, "gradient", lambda model, ablation, steps, more: 3.0 * steps)
    monkeypatch.setattr(sys, "argv", ["gradients.py"])
    assert gradients.main() == 0
    lines = capsys.readouterr().out.splitlines()
    rows = [line for line in lines if line.startswith(("| cnn_patch", "| patch_pf"))]
    assert len(rows) == 2 * len(gradients.SHOWN)
    assert all(row.endswith("| 1.0 | 2.0 | 4.0 | 8.0 | 16 | 30 |") for row in rows)


def test_single_ablations_can_be_asked_for(
    gradients, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = []
    monkeypatch.setattr(gradients, "gradient", lambda *args: asked.append(args) or 1.0)
    unit = "model.displacement.unit=1"
    monkeypatch.setattr(
        sys, "argv", ["gradients.py", unit, "--only", "paper", "--only", "s2_bounded"]
    )
    assert gradients.main() == 0
    assert {(ablation, *more) for _, ablation, _, more in asked} == {
        ("paper", unit),
        ("s2_bounded", unit),
    }
    assert capsys.readouterr().out.count("| 1.0 |") >= 4


@pytest.mark.slow
def test_a_detached_position_ends_the_growth(gradients, tmp_path: Path) -> None:
    """Through smooth glimpses each step multiplies the gradient; detached, it only adds up."""
    small = [
        f"data.root={tmp_path / 'scenes'}",
        "data.generate.frames=4",
        "data.generate.frames_per_scene=2",
        "data.limit_train=2",
    ]
    small += [
        "data.limit_val=2",
        "data.limit_test=2",
        "data.batch_size=2",
        "filter.particles=8",
        "threads=1",
    ]
    growth = {}
    for ablation in ("c3_bounded", "c6_position"):
        first, last = (gradients.gradient("cnn_patch", ablation, steps, small) for steps in (1, 8))
        growth[ablation] = last / first
    assert growth["c3_bounded"] > 1000
    assert growth["c6_position"] < 10
