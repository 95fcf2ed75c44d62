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


@pytest.mark.parametrize("name", ["mustard_d", "sugar_v", "banana_x", "tuna_y"])
def test_renders_are_tested_on_by_the_split_that_no_training_has_seen(name: str) -> None:
    run = next(one for one in photograph_runs.plan() if one.name == name)
    _, renders = photographs.evaluate_commands(run, Path("root"), "meshes", "frames")
    assert photograph_runs.SPLIT in renders
    assert "data.root=root/data" in renders


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


def test_the_file_has_the_runs_that_are_there_and_keeps_the_others(tmp_path: Path) -> None:
    run, gone = photograph_runs.plan()[:2]
    path = tmp_path / "runs.csv"
    tests = [title for title, _, _ in photographs.TESTS]
    kept = [f"{test},{gone.name},a run that is no longer there" for test in tests]
    old = [f"{test},{run.name},old" for test in tests]
    path.write_text("\n".join([",".join(photographs.HEAD), *old, *kept]) + "\n")
    values = {
        f"runs/{run.name}": metrics(99.0, 2),
        f"evals/{run.name}/renders": metrics(88.0, 60),
        f"evals/{run.name}/photographs": metrics(77.0, 20),
    }
    for folder, content in values.items():
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "metrics.json").write_text(json.dumps(content))
    photographs.write_runs(tmp_path, path)
    head, *rows = path.read_text().splitlines()
    assert head == ",".join(photographs.HEAD)
    assert rows[1::2] == kept
    assert rows[4] == old[2]  # no run of few images
    first = f"{run.name},{run.object},pose_pf"
    end = f"cracker box,{run.steps},5.0"
    assert rows[0].startswith(f"renders,{first},")
    assert rows[0].endswith(f"{end},60,88.0,89.0,90.0,90.0,4.2,25")
    assert rows[2].startswith(f"photographs,{first},")
    assert rows[2].endswith(f"{end},20,77.0,78.0,90.0,90.0,4.2,25")


def test_the_file_in_the_docs_stays_as_it_is_without_runs(tmp_path: Path) -> None:
    copy = tmp_path / "runs.csv"
    copy.write_bytes(photographs.RUNS.read_bytes())
    photographs.write_runs(tmp_path, copy)
    assert copy.read_bytes() == photographs.RUNS.read_bytes()


def read_figures(page: Path, title: str) -> dict[str, list[str]]:
    """Return the cells of the first table of objects below a heading of a page, by object."""
    below = page.read_text().split(f"\n## {title}\n")[1].split("\n## ")[0]
    found: dict[str, list[str]] = {}
    for line in below.splitlines():
        name, *cells = [cell.strip(" `") for cell in line.strip("|").split("|")]
        if name[:1] == "0":
            found.setdefault(name.removesuffix(".ckpt"), cells)
    return found


def test_the_figures_of_what_ships_are_those_beside_the_weights() -> None:
    weights = HOME / "weights" / "README.md"
    real = read_figures(weights, "Accuracy on real images")
    rendered = read_figures(weights, "Accuracy on held-out synthetic images")
    page = HOME / "docs" / "results" / "photographs.md"
    shown = read_figures(page, "Accuracy of the pretrained weights")
    assert set(shown) == set(real) == set(rendered) == set(photograph_runs.TARGETS)
    for name, cells in shown.items():
        photographed = ["–"] * 3 if real[name][1] == "in neither" else real[name][1:4]
        assert cells[:3] == photographed, name
        area, symmetric, recall = rendered[name][1:4]
        assert cells[3:] == [area, symmetric.split(" ")[0], recall], name


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
