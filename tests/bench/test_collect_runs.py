"""Runs become rows of one CSV file, in an order that people count in."""

import csv
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture
def collect(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """Return the script."""
    return load_script("bench/collect_runs.py")


def write_run(folder: Path, on: float, *overrides: str) -> None:
    folder.mkdir(parents=True)
    metrics = {
        "particles_on_object": on,
        "iou": 0.5,
        "add": {"auc": 40.0},
        "overrides": list(overrides),
        "seed": 0,
    }
    (folder / "metrics.json").write_text(json.dumps(metrics))


def test_what_decides_no_result_is_left_out(collect: ModuleType, tmp_path: Path) -> None:
    typed = ("model=patch_pf", "variant=paper", "seed=1", "console=json", "data.workers=2")
    write_run(tmp_path / "a", 0.9, *typed, "filter/resample=none", "data.limit_train=6")
    (run,) = collect.read_runs(tmp_path)
    wanted = ("patch_pf", "paper", "data.limit_train=6 filter/resample=none")
    assert collect.describe(run) == wanted


def test_seeds_that_differ_in_a_late_digit_are_rows_of_their_own(
    collect: ModuleType, tmp_path: Path
) -> None:
    for seed in (20260101, 20260102):
        write_run(tmp_path / str(seed), 0.9, "model=patch_pf")
        path = tmp_path / str(seed) / "metrics.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), "seed": seed}))
    rows = collect.make_rows("own", collect.read_runs(tmp_path))
    assert {row["seed"] for row in rows} == {"20260101", "20260102"}
    assert {row["on object %"] for row in rows} == {"90"}


def test_an_evaluation_in_a_runs_folder_is_no_row(collect: ModuleType, tmp_path: Path) -> None:
    """`evaluate.py checkpoint=RUN` writes there, and keeps the run's own results beside."""
    run, begun = tmp_path / "run", tmp_path / "begun"
    write_run(run, 0.9, "model=patch_pf", "filter.particles=50")
    (run / "metrics.json").rename(run / "metrics_train.json")
    for folder in (run, begun):
        (folder / "checkpoints").mkdir(parents=True)
        found = {"particles_on_object": 0.1, "overrides": ["checkpoint=run"], "seed": 0}
        (folder / "metrics.json").write_text(json.dumps({**found, "command": "evaluate"}))
    write_run(run / "evaluation_1", 0.2, "checkpoint=run")
    (row,) = collect.make_rows("own", collect.read_runs(tmp_path))
    assert (row["method"], row["changed"], row["on object %"]) == (
        "patch_pf",
        "filter.particles=50",
        "90",
    )


def test_names_of_before_are_those_of_today(collect: ModuleType, tmp_path: Path) -> None:
    write_run(tmp_path / "a", 0.9, "model=pose_pf", "filter.first_particles=100")
    (run,) = collect.read_runs(tmp_path)
    assert collect.describe(run)[2] == "filter.initial_particles=100"


def test_rows_follow_the_table_of_ablations_and_numbers_their_size(collect: ModuleType) -> None:
    def rows(*changes: str) -> list[dict[str, str]]:
        same = {"table": "t", "method": "m", "variant": "paper", "seed": "0"}
        return [{**same, "changed": change} for change in changes]

    def sort(*changes: str) -> list[str]:
        return [row["changed"].split("=")[1] for row in sorted(rows(*changes), key=collect.order)]

    names = ["paper", "s1_glimpse", "c2_glimpse", "c10_resample", "working", "m3_bounded"]
    ordered = sort(*(f"ablation={name}" for name in sorted(names)))
    assert sorted(ordered, key=collect.ORDER.get) == ordered
    assert ordered.index("c2_glimpse") < ordered.index("c10_resample")
    ordered = sort(*(f"filter.particles={n}" for n in (1000, 50, 100)))
    assert ordered == ["50", "100", "1000"]


def test_a_run_replaces_its_own_row_and_no_other(
    collect: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_run(tmp_path / "runs" / "memorize" / "a", 0.9, "model=patch_pf", "variant=working")
    write_run(tmp_path / "runs" / "other" / "deep" / "b", 0.1, "model=patch_pf", "variant=paper")
    into = tmp_path / "runs.csv"
    monkeypatch.setattr(collect, "run_command", lambda words: 0)
    monkeypatch.setattr(sys, "argv", ["collect_runs", str(tmp_path / "runs"), "--out", str(into)])
    assert collect.main() == 0
    (tmp_path / "runs" / "memorize" / "a" / "metrics.json").unlink()
    (tmp_path / "runs" / "other" / "deep" / "b" / "metrics.json").unlink()
    write_run(tmp_path / "runs" / "other" / "c", 0.3, "model=patch_pf", "variant=paper")
    more = ("model=patch_pf", "variant=paper", "loss=add")
    write_run(tmp_path / "runs" / "other" / "d", 0.2, *more)
    assert collect.main() == 0
    rows = list(csv.DictReader(into.open()))
    found = [tuple(row[name] for name in ("table", "changed", "on object %")) for row in rows]
    assert found == [("memorize", "", "90"), ("other", "", "30"), ("other", "loss=add", "20")]
    assert rows[0]["AUROC"] == "", "a figure that a run has not"


def test_rows_of_before_have_todays_names(collect: ModuleType, tmp_path: Path) -> None:
    into = tmp_path / "runs.csv"
    into.write_text(
        "table,changed,along a line at start %,along a line %,seed\n"
        "t,filter/resample@model.train_filter.resample=soft loss=belief_nll_pose,64.20,90.10,0\n"
    )
    (row,) = collect.read_rows(into)
    assert row == {
        "table": "t",
        "changed": "filter/resample@model.train_rollout.resample=soft loss=belief_nll_pose",
        "first-axis share at start %": "64.20",
        "first-axis share %": "90.10",
        "seed": "0",
    }


def test_the_committed_columns_have_todays_names(collect: ModuleType) -> None:
    with (collect.HOME / "docs" / "results" / "runs.csv").open() as file:
        columns = next(csv.reader(file))
    assert columns == ["table", "method", "variant", "changed", *collect.COLUMNS, "device", "torch"]


def test_a_folder_without_runs_is_refused(
    collect: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    into = tmp_path / "runs.csv"
    monkeypatch.setattr(sys, "argv", ["collect_runs", str(tmp_path), "--out", str(into)])
    assert collect.main() == 1
    assert "holds no run" in capsys.readouterr().err
    assert not into.exists()


def test_ranges_of_visibility_become_rows_of_a_table_that_shows_them(
    collect: ModuleType, tmp_path: Path
) -> None:
    write_run(tmp_path / "a", 0.9, "model=pose_pf", "data=fat")
    path = tmp_path / "a" / "metrics.json"
    range_of = {"0.3-0.5": {"instances": 7, "add": {"auc": 30.0}}}
    path.write_text(json.dumps(json.loads(path.read_text()) | {"by_visibility": range_of}))
    runs = collect.read_runs(tmp_path)
    rows = collect.make_rows("shipped", runs)
    found = [(row["method"], row["changed"], row["ADD AUC"], row["seed"]) for row in rows]
    assert found == [
        ("pose_pf", "data=fat", "40", "0"),
        ("pose_pf", "data=fat visibility=0.3-0.5", "30", "0"),
    ]
    assert rows[1]["box IoU"] == "", "a figure of the whole run alone"
    assert len(collect.make_rows("other", runs)) == 1
