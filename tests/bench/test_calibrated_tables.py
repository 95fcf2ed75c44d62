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

from posefilter.belief import Belief
from posefilter.confidence.tolerance import PoseTolerance
from posefilter.types import BeliefBatch

sys.path.insert(0, str(Path(__file__).parents[2] / "bench"))  # scripts import their neighbors
Load = Callable[[str], ModuleType]


@pytest.fixture
def bench(load_script: Load) -> ModuleType:
    return load_script("bench/calibrated.py")


def belief() -> BeliefBatch:
    """Return a belief of one particle about one image."""
    pose = torch.eye(4)[None]
    return BeliefBatch(pose[:, None], torch.zeros(1, 1), pose, torch.zeros(1))


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
    # one of the points lies ten pixels to the left, the other beyond the right edge
    size = (batch.depth.shape[-2], width)
    seen = bench.Observation(belief(), {}, pose, K, torch.tensor([0.6]), size, ("a",))
    assert float(bench.measure_shown(seen, wide)) == pytest.approx(0.3)


def test_the_band_of_a_belief_at_the_truth_holds_the_outline_and_one_beside_it_does_not(
    bench: ModuleType,
) -> None:
    batch = scenes(1)
    hull = np.random.default_rng(0).normal(size=(60, 3)) * 0.03
    truth = np.eye(4)
    truth[2, 3] = 1.0
    height, pixels = batch.depth.shape[-2:]
    K = np.array([[pixels, 0.0, pixels / 2], [0.0, pixels, pixels / 2], [0.0, 0.0, 1.0]])
    beside = truth.copy()
    beside[0, 3] = 0.2
    for pose, least, most in ((truth, 1.0, 1.0), (beside, -1.0, 0.2)):
        one = Belief(pose[None], np.ones(1), np.zeros(3), 0.1, 0.2)
        held = bench.measure_band(one, truth, hull, K, (height, pixels))
        assert least <= held <= most


def test_what_a_filter_leaves_is_kept_and_read_again(bench: ModuleType, tmp_path: Path) -> None:
    poses, K = torch.eye(4).expand(2, 4, 4), torch.eye(3).expand(2, 3, 3)
    features = {"score": torch.tensor([1.0, 2.0]), "surface": torch.tensor([0.5, torch.nan])}
    many = BeliefBatch(*(torch.cat([part, part]) for part in belief()))
    shown = torch.tensor([0.1, 0.2])
    given = bench.Observation(many, features, poses, K, shown, (120, 160), ("a", "b"))
    bench.save_observation(given, tmp_path / "thing.with.0000.npz")
    assert [file.name for file in tmp_path.iterdir()] == ["thing.with.0000.npz"]
    again = bench.load_observation(tmp_path / "thing.with.0000.npz")
    assert again[5:] == given[5:]
    assert list(again.features) == list(features)
    pairs = [*zip(again.belief, many, strict=True), *zip(again[2:5], given[2:5], strict=True)]
    pairs += [(again.features[key], features[key]) for key in features]
    for a, b in pairs:
        assert torch.equal(a.nan_to_num(7.0), b.nan_to_num(7.0))


def test_beliefs_of_right_answers_are_counted_both_ways(bench: ModuleType) -> None:
    own = {"off": [0.001, 0.1], "says": [0.002, 0.05], "within": [True, False], "level": 0.6}
    own |= {"log_density": 3.0}
    plain = {f"plain_{key}": value for key, value in own.items()}
    plain |= {"plain_level": 0.99, "plain_rank": 0.97, "plain_band": 0.5}
    rows = [row(True, 0.9, True, **own, **plain), row(True, 0.1), row(False, 0.1)]
    table = [line.split(" | ") for line in bench.tabulate_beliefs(rows).splitlines()]
    calibrated, filtered = (line[2:] for line in table if line[0] == "| all")
    assert calibrated[:4] == ["1", *["0 / 100 / 100 / 100"] * 2, "100 / 0"]
    assert calibrated[4:7] == ["2.0 mm, 2.9", "100", "3.0"]
    assert filtered[:3] == ["1", *["0 / 0 / 0 / 0"] * 2]
    assert len(bench.tabulate_beliefs(rows[1:]).splitlines()) == 2  # none is right


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
