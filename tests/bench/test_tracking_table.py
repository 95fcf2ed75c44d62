"""Rows of the page on tracking: those of what did not run stay."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "bench"))  # scripts import their neighbors


def test_rows_of_the_same_first_cells_are_replaced_in_place(
    load_script: Callable[[str], ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = load_script("bench/tracking.py")
    page = tmp_path / "page.md"
    page.write_text(
        "before\n<!-- table: losses -->\n| h | i | j |\n| --- | --- | --- |\n"
        "| a | 1 | old |\n| b | 1 | old |\n<!-- end -->\nafter\n"
    )
    monkeypatch.setattr(bench, "PAGE", page)
    bench.write_table("losses", ("h", "i", "j"), ["| a | 1 | new |", "| a | 2 | new |"], 2)
    assert page.read_text() == (
        "before\n<!-- table: losses -->\n| h | i | j |\n| --- | --- | --- |\n"
        "| a | 1 | new |\n| b | 1 | old |\n| a | 2 | new |\n<!-- end -->\nafter\n"
    )
