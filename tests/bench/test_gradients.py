"""The table of gradients: its measure, its numbers as they are written, and its place in the page."""

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


def test_a_page_without_the_mark_is_refused_before_anything_is_measured(
    gradients, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.md"
    page.write_text("nothing\n")
    monkeypatch.setattr(sys, "argv", ["gradients.py", "--into", str(page)])
    with pytest.raises(SystemExit):
        gradients.main()
    assert "no mark" in capsys.readouterr().err


def test_the_page_gets_a_row_a_rung(
    gradients, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = tmp_path / "page.md"
    page.write_text("a\n<!-- table: gradients -->\nold\n<!-- end -->\nb\n")
    monkeypatch.setattr(
        gradients, "gradient", lambda model, sweep, ablation, steps, more: 3.0 * steps
    )
    monkeypatch.setattr(sys, "argv", ["gradients.py", "--into", str(page)])
    assert gradients.main() == 0
    lines = page.read_text().splitlines()
    assert lines[0] == "a"
    assert lines[-1] == "b"
    assert "old" not in lines
    rows = [line for line in lines if line.startswith(("| cnn_patch", "| patch_pf"))]
    assert len(rows) == 2 * len(gradients.RUNGS)
    assert all(row.endswith("| 1.0 | 2.0 | 4.0 | 8.0 | 16 | 30 |") for row in rows)


@pytest.mark.slow
def test_a_place_that_is_taken_as_given_ends_the_growth(gradients, tmp_path: Path) -> None:
    """With smooth glimpses and bounded displacement each step multiplies the gradient; stopped at
    the place, it only adds up.
    """
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
        first, last = (
            gradients.gradient("cnn_patch", "ablation_detect", ablation, steps, small)
            for steps in (1, 8)
        )
        growth[ablation] = last / first
    assert growth["c3_bounded"] > 1000
    assert growth["c6_position"] < 10
