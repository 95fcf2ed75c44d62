"""A dataset whose depth is in another unit than the reader takes it for is noticed."""

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from posefilter.cli import run_command
from posefilter.metrics.scale_ratio import ScaleRatios

HOME = Path(__file__).parents[2]
SCENES = HOME / "docs" / "scenes"


def evaluate(
    root: Path, out: Path, capfd: pytest.CaptureFixture[str]
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Test the weights that ship; return the metrics, and the warnings as read from the console."""
    words = ["checkpoint=003_cracker_box", "data=fat", f"data.root={root}", f"out={out}"]
    words += ["data.split={test: 1.0}", "absent_frames=0", "threads=1", "console=json"]
    assert run_command("evaluate", HOME, words) == 0
    lines = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    metrics = json.loads((out / "metrics.json").read_text())
    return metrics, [line for line in lines if line["event"] == "warning"]


@pytest.mark.slow
def test_depth_of_another_scale_is_told(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    metrics, warnings = evaluate(SCENES, tmp_path / "right", capfd)
    assert metrics["scale_ratio"] == {
        "images": 6,
        "ratio": pytest.approx(1, abs=0.06),
        "contradicting": 0,
    }
    assert metrics["confidence"]["found"] == 1
    assert not warnings

    wrong = tmp_path / "scenes"
    shutil.copytree(SCENES, wrong)
    for path in map(str, wrong.rglob("*.depth.png")):
        depth = cv2.imread(path, cv2.IMREAD_UNCHANGED)
        cv2.imwrite(path, np.round(1.25 * depth).astype(depth.dtype))
    metrics, warnings = evaluate(wrong, tmp_path / "wrong", capfd)
    assert metrics["scale_ratio"]["ratio"] == pytest.approx(1.25, rel=0.06)
    assert metrics["scale_ratio"]["contradicting"] > 3
    assert metrics["confidence"]["found"] < 0.5
    assert [line["ratio"] for line in warnings] == [metrics["scale_ratio"]["ratio"]]


def test_images_that_tell_nothing_are_not_counted() -> None:
    metric = ScaleRatios()
    assert metric.compute() is None
    metric.update(torch.tensor([torch.nan]), torch.tensor([False]))
    assert metric.compute() is None
    metric.update(
        torch.tensor([1.2, torch.nan, 1.3, 0.9]), torch.tensor([True, False, True, False])
    )
    found = metric.compute()
    assert found == {"images": 3, "ratio": pytest.approx(1.2), "contradicting": 2}
