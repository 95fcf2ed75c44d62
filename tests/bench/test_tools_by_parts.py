"""Tools by parts: rows of the table are means over the seeds that were tested in every way."""

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture
def tools(
    load_script: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> ModuleType:
    """Return the program, whose home is an empty folder."""
    script = load_script("bench/tools.py")
    monkeypatch.setattr(script, "HOME", tmp_path)
    return script


def write(tools: ModuleType, seed: int, end: str, auc: float) -> None:
    folder = tools.HOME / tools.Run("pose_pf", "048_hammer", seed).test_folder("parts_pf", end)
    folder.mkdir(parents=True)
    parts = {"box_iou": auc / 100, "mask_iou": 0.5}
    found = {"instances": 7, "add": {"auc": auc}, "add_s": {"auc": 90.0}, "parts": parts}
    (folder / "metrics.json").write_text(json.dumps(found))


def test_a_row_is_the_mean_of_the_seeds_that_are_done(tools: ModuleType) -> None:
    assert tools.tabulate_parts("048_hammer", "parts_pf", [0, 1, 2]) == []
    for seed in (0, 1):
        write(tools, seed, "refined", 60.0 + 10 * seed)
        write(tools, seed, "plain", 40.0 + 10 * seed)
    write(tools, 2, "plain", 0.0)  # refined it was not tested
    (row,) = tools.tabulate_parts("048_hammer", "parts_pf", [0, 1, 2])
    assert row == (
        "| 048_hammer | `parts_pf` | 0, 1 | 7 | 65.0 | 90.0 | 0.650 | 0.500 "
        "| 45.0 | 90.0 | 0.450 | 0.500 |"
    )
    assert row.count("|") == len(tools.PARTS_HEAD) + 1


def test_the_same_weights_are_tested_in_every_way(tools: ModuleType) -> None:
    run = tools.Run("pose_pf", "048_hammer", 1)
    commands = [
        tools.test_command(run, name, end, ["threads=1"])
        for name in tools.FILTERS
        for end in tools.ENDS
    ]
    assert len({tuple(one) for one in commands}) == len(commands) == 6
    assert {one[1] for one in commands} == {f"checkpoint={run.folder}"}
    by_parts = [set(tools.BY_PARTS) <= set(one) for one in commands]
    assert by_parts == [False] * 2 + [True] * 4
    assert str(run.folder).endswith("pose_pf_048_hammer_seed1")


def test_rows_of_a_tool_stay_together(tools: ModuleType) -> None:
    rows = ["| a | `x` | 1 |", "|  |  | 2 |", "| b | `x` | 3 |", "| a | `y` | 4 |"]
    assert tools.group_rows(rows) == {"a": [rows[0], rows[1], rows[3]], "b": [rows[2]]}
