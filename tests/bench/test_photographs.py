"""The plan of runs on photographs, its table, and the shifts of color that filters are measured
under.
"""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from posefilter.cli.command import compose_job
from posefilter.data.frames import Sample

HOME = Path(__file__).parents[2]
sys.path.insert(0, str(HOME / "bench"))  # scripts import their neighbors


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, HOME / "bench" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


photographs, color_shift = load("photographs"), load("color_shift")
photograph_runs = load("photograph_runs")


def kinds() -> list[Any]:
    """Return one run of each kind: those that differ in more than object, steps and start."""
    found = {}
    for run in photograph_runs.plan():
        words = [word for word in run.words.split() if not word.startswith("warm_start=")]
        found.setdefault((run.model, *words), run)
    return list(found.values())


@pytest.mark.parametrize("run", kinds(), ids=lambda run: run.name)
def test_every_kind_of_training_composes(run: Any, tmp_path: Path) -> None:
    words = photographs.train_command(run, Path("somewhere"))
    job = compose_job("train", HOME / "conf", words[1:], tmp_path)
    assert job.cfg.data.object == run.object
    assert job.cfg.trainer.max_steps == run.steps
    assert job.choices["model"] == run.model


def test_a_warm_start_comes_after_the_run_that_it_starts_from() -> None:
    done = []
    for run in photograph_runs.plan():
        if photograph_runs._best("drill_patch_camera") in run.words:
            assert "drill_patch_camera" in done
        if photograph_runs.CRACKER in run.words:
            assert (HOME / photograph_runs.CRACKER).is_file()
        assert run.object in photograph_runs.TARGETS
        assert run.name not in done
        done.append(run.name)


def metrics(auc: float, instances: int) -> dict[str, Any]:
    add = {"auc": auc, "recall_01d": 90.0, "recall_2cm": 95.0, "median_mm": 4.25}
    training = {"steps": 600, "cpu_seconds_per_step": 0.5}
    belief = {"truth_outscored_by_wrong": 0.25}
    return {
        "instances": instances,
        "add": add,
        "add_s": {**add, "auc": auc + 1},
        "belief": belief,
        "training": training,
    }


def test_the_tables_show_the_runs_that_are_there_and_leave_the_rest_of_the_page(
    tmp_path: Path,
) -> None:
    run, gone = photograph_runs.plan()[:2]
    page = tmp_path / "page.md"
    marks = [f"<!-- table: {title} -->" for title, _, _ in photographs.TABLES]
    kept = f"| `{gone.name}` | a run that is no longer there |"
    old = f"| run |\n| --- |\n| `{run.name}` | old |\n{kept}\n"
    page.write_text("Above.\n" + "".join(f"{m}\n{old}<!-- end -->\nBelow.\n" for m in marks))
    values = {
        f"runs/{run.name}": metrics(99.0, 2),
        f"evals/{run.name}/renders": metrics(88.0, 60),
        f"evals/{run.name}/photographs": metrics(77.0, 20),
    }
    for folder, content in values.items():
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "metrics.json").write_text(json.dumps(content))
    photographs.write_tables(tmp_path, page)
    text = page.read_text()
    assert text.startswith("Above.\n")
    assert text.count("\nBelow.\n") == 3
    assert text.count(kept) == 3
    assert text.count("old") == 1  # no run of few images
    rows = [line for line in text.splitlines() if line.startswith(f"| `{run.name}`")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in rows]
    assert [each[5:7] for each in cells[:2]] == [[str(run.steps), "5.0"]] * 2
    assert cells[0][7:] == ["60", "88.0", "89.0", "90.0", "90.0", "4.2", "25"]
    assert cells[1][7:] == ["20", "77.0", "78.0", "90.0", "90.0", "4.2", "25"]
    page_in_docs = photographs.PAGE.read_text()
    assert all(mark in page_in_docs for mark in marks)


def _sample(rgb: np.ndarray) -> Sample:
    mask = np.zeros(rgb.shape[:2], bool)
    mask[1:7, 1:7] = True
    eye = np.eye(4, dtype=np.float32)
    return Sample(rgb, np.ones(rgb.shape[:2], np.float32), mask, eye[:3, :3], eye, 0, 0, 1.0)


def test_the_first_shift_changes_nothing_and_all_others_do() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (8, 8, 3), dtype=np.uint8)
    for name, recolor in color_shift.shifts().items():
        assert np.array_equal(recolor(_sample(rgb)), rgb) == (name == "as it is"), name


def test_a_label_on_the_object_takes_the_color_of_the_object() -> None:
    rgb = np.zeros((8, 8, 3), np.uint8) + np.uint8([140, 40, 30])
    rgb[2:4, 2:4] = rgb[0, 0] = 240  # a label, and something light that is no part of the object
    after = color_shift.paint_labels(_sample(rgb))
    assert (after[1:7, 1:7] == [140, 40, 30]).all()
    assert (after[0, 0] == 240).all()
