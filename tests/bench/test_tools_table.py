"""The bench of tools: its plan, and the rows of its table."""

from collections.abc import Callable
from types import ModuleType

import pytest


@pytest.fixture
def tools(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("bench/tools.py")


def test_poses_are_learned_of_the_whole_and_masks_of_each_part(tools: ModuleType) -> None:
    runs = tools.plan("048_hammer", ("head", "handle"))
    assert {run.model for run in runs} == {
        "pixel_pf",
        "patch_pf",
        "pose_pf",
        "cnn_patch",
        "downsized",
    }
    for run in runs:
        assert ("." in run.object) == (run.model in ("cnn_patch", "downsized"))
    assert len({run.folder for run in runs}) == len(runs) == 7


def test_a_pose_has_a_row_for_each_part_and_its_errors_once(tools: ModuleType) -> None:
    by_part = {
        "head": {"box_iou": 0.5, "mask_iou": 0.25},
        "handle": {"box_iou": 0.125, "mask_iou": 1},
    }
    metrics = {"training": {"steps": 7}, "instances": 9, "iou": 0.75, "add": {"auc": 12.34}}
    rows = tools.tabulate(
        tools.Run("pose_pf", "048_hammer"),
        metrics | {"add_s": {"auc": 56.78}, "parts": {"by_part": by_part}},
    )
    assert rows == [
        "| 048_hammer | `pose_pf` | whole | 7 | 9 | 0.750 | head | 0.500 | 0.250 | 12.3 | 56.8 |",
        "|  |  |  |  |  |  | handle | 0.125 | 1.000 |  |  |",
    ]


def test_a_detector_of_a_part_has_its_box_iou_alone(tools: ModuleType) -> None:
    metrics = {"training": {"steps": 7}, "instances": 9, "iou": 0.75, "add": None}
    assert tools.tabulate(tools.Run("cnn_patch", "048_hammer.head"), metrics) == [
        "| 048_hammer | `cnn_patch` | head | 7 | 9 | 0.750 | head | – | – | – | – |"
    ]
