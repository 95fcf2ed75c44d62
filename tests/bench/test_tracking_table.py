"""Rows of the page on tracking: those of what did not run stay."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from posefilter.data.sequences import VideoFrame

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


def test_a_gap_while_the_object_is_covered_is_no_step(
    load_script: Callable[[str], ModuleType],
) -> None:
    bench = load_script("bench/tracking.py")
    frames = []
    for number in range(9):
        pose = np.eye(4)
        pose[:3, 3] = 0.01 * number, 0, 1
        truth = {} if 3 <= number < 7 else {"a": pose}
        empty = np.zeros((1, 1, 3), np.uint8), np.zeros((1, 1), np.float32), np.eye(3)
        frames.append(VideoFrame(str(number), number, *empty, truth))
    shift, turn = bench.measure_steps(frames, "a", torch.zeros(3).double())
    assert shift == pytest.approx(10)
    assert turn == pytest.approx(0, abs=1e-9)
