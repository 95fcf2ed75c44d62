"""The table of results, from metrics files written by hand."""

import csv
import importlib.util
import json
from pathlib import Path

import pytest
from torch.utils.tensorboard import SummaryWriter

SCRIPT = Path(__file__).parents[2] / "bench" / "methods_table.py"
spec = importlib.util.spec_from_file_location("methods_table", SCRIPT)
assert spec is not None
assert spec.loader is not None
methods_table = importlib.util.module_from_spec(spec)
spec.loader.exec_module(methods_table)


def run(folder: Path, on: float, *overrides: str, seconds: float = 0.1) -> None:
    folder.mkdir(parents=True)
    metrics = {
        "particles_on_object": on,
        "iou": 0.5,
        "add": {"auc": 40.0},
        "overrides": list(overrides),
    }
    metrics |= {"seconds_per_image": seconds}
    (folder / "metrics.json").write_text(json.dumps(metrics))


def test_seeds_are_joined_and_other_choices_kept_apart(tmp_path: Path) -> None:
    both = ("model=patch_pf", "experiment=memorize", "data.limit_train=6")
    run(tmp_path / "a", 0.9, *both, "seed=0", "variant=working")
    run(tmp_path / "b", 0.8, *both, "seed=1", "variant=working", "console=json")
    run(tmp_path / "c", 0.2, *both, "seed=0", "variant=paper")
    runs = methods_table.read_runs([tmp_path])
    lines = methods_table.table(runs).splitlines()
    assert lines[0] == "| method | variant | seeds | on object % | box IoU | ADD AUC |"
    assert lines[2] == "| patch_pf | paper | 1 | 20.0 | 0.50 | 40.0 |"
    assert lines[3] == "| patch_pf | working | 2 | 85.0 ± 5.0 | 0.50 ± 0.00 | 40.0 ± 0.0 |"


def test_what_a_single_row_changed_is_told(tmp_path: Path) -> None:
    run(tmp_path / "a", 0.9, "model=patch_pf", "variant=working", "filter/resample=none")
    assert (
        methods_table.table(methods_table.read_runs([tmp_path]))
        .splitlines()[2]
        .startswith("| patch_pf | `filter/resample=none` |")
    )


def test_time_is_told_in_units_of_the_fastest_row(tmp_path: Path) -> None:
    for seed, seconds in ((0, 0.02), (1, 0.04)):
        run(
            tmp_path / f"few{seed}",
            0.9,
            "model=patch_pf",
            "filter.particles=50",
            f"seed={seed}",
            seconds=seconds,
        )
    run(tmp_path / "many", 0.9, "model=patch_pf", "filter.particles=100", seconds=0.09)
    runs = methods_table.read_runs([tmp_path])
    lines = methods_table.table(runs, ["relative time"]).splitlines()
    assert [line.split("|")[-2].strip() for line in lines[2:]] == ["1.00 ± 0.33", "3.00"]
    assert "time" not in methods_table.table(runs)


def test_only_the_named_table_is_replaced_by_the_figures_asked_for(tmp_path: Path) -> None:
    run(tmp_path / "a", 0.9, "model=patch_pf")
    runs = methods_table.read_runs([tmp_path])
    page = "a\n<!-- table: x (ADD AUC, box IoU) -->\nold\n<!-- end -->\nb\n<!-- table: y -->\nkept\n<!-- end -->\n"
    asked = "| method | seeds | ADD AUC | box IoU |\n| --- | --- | --- | --- |\n| patch_pf | 1 | 40.0 | 0.50 |"
    assert methods_table.insert(page, "x", runs) == page.replace("old", asked)
    with pytest.raises(KeyError, match="IOU"):
        methods_table.insert(page.replace("box IoU", "IOU"), "x", runs)


def test_rows_climb_the_ladder_and_count_as_people_do(tmp_path: Path) -> None:
    ablations = (
        "paper",
        "c10_x",
        "c2_glimpse",
        "s1_glimpse",
        "pose_c9_own_point",
        "working",
        "m3_bounded",
    )
    keys = [("patch_pf", "paper", f"ablation={ablation}") for ablation in sorted(ablations)]
    wanted = [
        "paper",
        "s1_glimpse",
        "c2_glimpse",
        "c10_x",
        "pose_c9_own_point",
        "working",
        "m3_bounded",
    ]
    assert [
        key[2].removeprefix("ablation=") for key in sorted(keys, key=methods_table.place)
    ] == wanted
    counts = [("patch_pf", "working", f"filter.particles={n}") for n in (1000, 50, 100)]
    assert [key[2][17:] for key in sorted(counts, key=methods_table.place)] == ["50", "100", "1000"]
    assert (
        methods_table.told("ablation=c2_glimpse")
        == "`ablation=c2_glimpse` The same, and smooth glimpses"
    )


def test_each_folder_is_a_table(tmp_path: Path, monkeypatch, capsys) -> None:
    run(tmp_path / "runs" / "memorize" / "a", 0.9, "model=patch_pf", "variant=working")
    run(tmp_path / "runs" / "other" / "deep" / "b", 0.1, "model=patch_pf", "variant=paper")
    page = tmp_path / "page.md"
    page.write_text("<!-- table: memorize -->\nold\n<!-- end -->\n")
    monkeypatch.setattr("sys.argv", ["methods_table", str(tmp_path / "runs"), "--into", str(page)])
    assert methods_table.main() == 0
    assert "| patch_pf | 1 | 90.0 |" in page.read_text()
    assert "old" not in page.read_text()
    rows = list(csv.DictReader(page.with_suffix(".csv").open()))
    assert [(row["table"], row["variant"], row["on object %"]) for row in rows] == [
        ("memorize", "working", "90"),
        ("other", "paper", "10"),
    ]
    assert rows[0]["AUROC"] == "", "a figure that a run has not"
    assert "other: 1 runs (no such table" in capsys.readouterr().out


def test_loss_jumps_are_of_the_second_half(tmp_path: Path) -> None:
    assert methods_table.loss_jumps(tmp_path / "none") is None
    with SummaryWriter(str(tmp_path / "run")) as log:
        for step, value in ((20, 100.0), (100, 2.0), (120, 1.0), (200, 8.0)):
            log.add_scalar("train/total", value, step)
    assert methods_table.loss_jumps(tmp_path / "run") == 4.0
    run(tmp_path / "run" / "more", 0.9, "model=patch_pf")
    (tmp_path / "run" / "more" / "metrics.json").rename(tmp_path / "run" / "metrics.json")
    runs = methods_table.read_runs([tmp_path])
    assert methods_table.table(runs, ["loss jumps"]).endswith("| patch_pf | 1 | 4.00 |")
    assert "jumps" not in methods_table.table(runs), "reading it takes a while"
