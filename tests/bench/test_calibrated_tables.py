"""The tables of calibrated checkpoints count what they say."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from tests.models.toy import scenes

from posefilter.confidence.tolerance import PoseTolerance

sys.path.insert(0, str(Path(__file__).parents[2] / "bench"))  # scripts import their neighbors
Load = Callable[[str], ModuleType]


@pytest.fixture
def bench(load_script: Load) -> ModuleType:
    return load_script("bench/calibrated.py")


def row(there: bool, probability: float, right: bool = False, **more: Any) -> dict[str, Any]:
    base = {"object": "thing", "there": there, "right": right, "presence": probability}
    own = {"visibility": 1.0, "shown": 1.0, "rank": 0.6, "held": [True] * 4, "band": 1.0}
    return base | {"probability": probability} | (own if there else {}) | more


def test_coverage_is_counted_by_object_visibility_and_what_is_shown(bench: ModuleType) -> None:
    rows = [row(True, 0.9, True), row(True, 0.9, True, shown=0.1, held=[False, False, True, True])]
    rows += [row(True, 0.5, visibility=0.4, rank=0.96, band=0.5), row(False, 0.1)]
    table = [line.split(" | ") for line in bench.tabulate_coverage(rows).splitlines()]
    by_name = {line[0].removeprefix("| "): line[1:] for line in table}
    assert by_name["all"][:2] == ["3", "67 / 67 / 100 / 100"]
    assert by_name["all"][2:] == ["0 / 67 / 67 / 67", "83 |"]
    assert by_name["visibility 0.25 to 0.5"][0] == "1"
    assert by_name["shown 0 to 0.25"][:2] == ["1", "0 / 0 / 100 / 100"]
    assert by_name["shown 0.75 to 1"][0] == "2"


def test_probabilities_are_counted_among_all_and_presence_among_what_is_shown(
    bench: ModuleType,
) -> None:
    rows = [row(True, 0.95, True), row(True, 0.9), row(True, 0.1, shown=0.1)]
    rows += [row(False, 0.85), row(False, 0.05)]
    cells = bench.tell_confidence(rows)
    assert cells[0] == "3, 2"
    assert cells[1] == "1.000"  # the right one is above both wrong ones
    assert cells[4] == f"{5 / 6:.3f}"  # 0.1 is below 0.85
    assert cells[5] == "1.000"
    assert cells[7:] == ["67 %", "1", "1", "1"]


def test_shown_is_visible_and_in_the_frame(bench: ModuleType) -> None:
    batch = scenes(1)
    wide = torch.tensor([[-0.01, 0.0, 0.0], [0.01, 0.0, 0.0]])
    pose = torch.eye(4)[None].clone()
    pose[0, 2, 3] = 1.0
    width = batch.depth.shape[-1]
    K = torch.tensor([[[1e3, 0.0, width - 5.0], [0.0, 1e3, 5.0], [0.0, 0.0, 1.0]]])
    seen = batch._replace(
        camera_from_object=pose, intrinsics=K, visibility=torch.tensor([0.6])
    )  # one of the points lies ten pixels to the left, the other beyond the right edge
    assert float(bench.measure_shown(seen, wide)) == pytest.approx(0.3)


def test_the_band_of_a_belief_at_the_truth_holds_the_outline_and_one_beside_it_does_not(
    bench: ModuleType,
) -> None:
    batch = scenes(1)
    hull = np.random.default_rng(0).normal(size=(60, 3)) * 0.03
    truth = np.eye(4)
    truth[2, 3] = 1.0
    pixels = batch.depth.shape[-1]
    K = torch.tensor([[[pixels, 0.0, pixels / 2], [0.0, pixels, pixels / 2], [0.0, 0.0, 1.0]]])
    one = batch._replace(intrinsics=K)
    beside = truth.copy()
    beside[0, 3] = 0.2
    for pose, least, most in ((truth, 1.0, 1.0), (beside, -1.0, 0.2)):
        held = bench.measure_band(pose[None], np.ones(1), truth, hull, one)
        assert least <= held <= most


def test_each_scene_is_judged_by_the_others(bench: ModuleType) -> None:
    rng = np.random.default_rng(0)
    rows = []
    for i in range(300):
        there, scene = i % 2 == 0, f"scene{i // 6}"
        seen = {"coordinates": float(rng.normal(2.0 * there)), "score": float(rng.normal())}
        own = row(there, 0.5, there and seen["coordinates"] > 1.5, scene=scene, features=seen)
        # of one scene no truth conforms: its own calibration would hold it
        own |= (
            {"nonconformity": 100.0 if scene == "scene3" else float(rng.normal())} if there else {}
        )
        rows.append(own)
    judged = bench.judge_across(rows)
    assert len(judged) == len(rows)
    own = [one for one in judged if one["there"]]
    assert all(one["held"] == [False] * 4 for one in own if one["scene"] == "scene3")
    others = np.mean([one["held"] for one in own if one["scene"] != "scene3"], axis=0)
    assert np.abs(others - [0.5, 0.8, 0.9, 0.95]).max() < 0.1
    assert np.mean([one["presence"] for one in own]) > 0.6
    assert rows[0]["presence"] == 0.5  # what was given stays
    blind = bench.judge_across(rows, leave_out=["coordinates"])
    assert np.mean([one["presence"] for one in blind if one["there"]]) < 0.55
    for one in rows:  # by ADD-S all are right, by ADD those that were
        errors = [0.001, 0.1, 0.05 if one["right"] else 0.3, 0.04]
        one["errors"] = errors if one["there"] else [np.nan] * 4
    wide = bench.judge_across(rows, tolerance=PoseTolerance(add_s=0.1))
    assert all(one["right"] == one["there"] for one in wide)
    usual = bench.judge_across(rows)
    assert [one["right"] for one in usual] == [one["right"] for one in judged]
    pairs = [(a, b) for a, b in zip(wide, usual, strict=True) if a["there"]]
    # a third of those that are there are wrong by ADD, and none by ADD-S
    assert np.mean([a["probability"] for a, _ in pairs]) > 1.2 * np.mean(
        [b["probability"] for _, b in pairs]
    )
    assert [a["held"] for a, _ in pairs] == [b["held"] for _, b in pairs]
    few = bench.judge_across(rows, max_frames=15)
    assert all(one["held"][3] for one in few if one["there"])  # fewer than 19: every pose
