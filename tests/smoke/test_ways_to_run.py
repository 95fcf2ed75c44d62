"""Loggers, tags, debug options and a search, each as it is typed, at toy size."""

import csv
import importlib.util
import json
from pathlib import Path

import pytest
import yaml
from tests.smoke.conftest import HOME, TINY

from posefilter.cli import run_command
from posefilter.cli.comparing import leaves
from posefilter.metrics.results import compute_checkpoint_score

SMOKE = yaml.safe_load((HOME / "conf" / "debug" / "smoke.yaml").read_text())
TOY = [f"{key}={value}" for key, value in leaves({k: SMOKE[k] for k in ("data", "trainer")})]


def read_csv(file: Path) -> list[dict[str, str]]:
    with file.open() as lines:
        return list(csv.DictReader(lines))


@pytest.mark.slow
def test_two_images_are_memorized(tiny_scenes: Path, tmp_path: Path) -> None:
    """And every logger is told the loss and the settings, tags among them."""
    typed = ["debug=overfit", "logger=csv", "tags=[first,two words]", "trainer.log_every_n_steps=1"]
    typed += ["model=patch_pf", "trainer.max_steps=25", "trainer.val_check_interval=25"]
    typed += [*TINY[1:3], f"data.root={tiny_scenes}", f"out={tmp_path}"]
    assert run_command("train", HOME, typed) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["tags"] == ["first", "two words"]
    assert metrics["instances"] == 2
    rows = read_csv(tmp_path / "csv" / "version_0" / "metrics.csv")
    losses = [float(row["train/loss"]) for row in rows if row["train/loss"]]
    assert len(losses) == 25
    assert sum(losses[-8:]) < 0.95 * sum(losses[:8])
    told = (tmp_path / "csv" / "version_0" / "hparams.yaml").read_text()
    assert "model: patch_pf" in told
    assert "two words" in told


@pytest.mark.slow
def test_a_profile_is_written(tiny_scenes: Path, tmp_path: Path) -> None:
    typed = ["debug=profiler", *TOY, "filter.particles=4", "filter.steps=2", "trainer.max_steps=2"]
    typed += ["model=cnn_patch", "callbacks=checkpoints"]
    typed += [*TINY[1:], f"data.root={tiny_scenes}", f"out={tmp_path}", "data.generate=null"]
    assert run_command("train", HOME, typed) == 0
    profile = (tmp_path / "fit-profile.txt").read_text()
    assert "run_training_batch" in profile


@pytest.mark.parametrize("logger", ["wandb", "mlflow"])
def test_a_logger_that_is_not_installed_is_one_line(
    logger: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    real = importlib.util.find_spec
    monkeypatch.setattr(
        "posefilter.cli.preflight.find_spec", lambda name: None if name == logger else real(name)
    )
    assert run_command("train", HOME, [f"logger={logger}", f"out={tmp_path / 'run'}"]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f"train: logger={logger}: the package {logger} is missing; pip install")
    assert f"posefilter[{logger}]" in line


@pytest.mark.parametrize("typed", ["tags=first", "tags=[{a: 1}]", "tags=[1]"])
def test_tags_are_words(typed: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run_command("train", HOME, [typed, f"out={tmp_path / 'run'}"]) == 2
    assert "must be a list of words" in capfd.readouterr().err


@pytest.mark.slow
def test_a_search_maximizes_the_score(tiny_scenes: Path, tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    search = ["-m", "hydra/sweeper=optuna"]
    search += ["hydra.sweeper.n_trials=2", "hydra.sweeper.n_jobs=1", "hydra.sweeper.sampler.seed=0"]
    typed = [*search, "filter.particles=int(interval(4,12))", f"out={tmp_path}"]
    typed += [*TINY, "model=downsized", f"data.root={tiny_scenes}", "trainer.max_steps=2"]
    assert run_command("train", HOME, typed) == 0
    found = yaml.safe_load((tmp_path / "optimization_results.yaml").read_text())
    assert found["name"] == "optuna"
    scores = {
        row["filter.particles"]: compute_checkpoint_score(
            json.loads((tmp_path / row["folder"] / "metrics.json").read_text())
        )
        for row in read_csv(tmp_path / "summary.csv")
    }
    assert len(scores) == 2
    best = str(found["best_params"]["filter.particles"])
    assert found["best_value"] == pytest.approx(scores[best])
    assert scores[best] == max(scores.values()) > min(scores.values())


@pytest.mark.slow
def test_a_callback_that_ends_a_training_is_noticed(
    tiny_scenes: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    stopping = "{_target_: lightning.pytorch.callbacks.EarlyStopping, monitor: val/score, mode: max"
    typed = [*TINY, "model=cnn_patch", f"data.root={tiny_scenes}", f"out={tmp_path}"]
    typed += ["callbacks=checkpoints", f"+callbacks.stop={stopping}, stopping_threshold: -1}}"]
    assert run_command("train", HOME, typed) == 0
    events = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    told = next(event for event in events if event["event"] == "ended")
    assert told == {"event": "ended", "step": 4, "steps": 8}


@pytest.mark.slow
def test_a_callback_that_waits_for_no_metric_of_ours_is_one_line(
    tiny_scenes: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    stopping = "+callbacks.stop={_target_: lightning.pytorch.callbacks.EarlyStopping, monitor: x/y}"
    typed = [*TINY, "model=cnn_patch", f"data.root={tiny_scenes}", f"out={tmp_path}", stopping]
    assert run_command("train", HOME, [*typed, "callbacks=checkpoints"]) == 2
    err = capfd.readouterr().err
    assert "train: trainer or callbacks: Early stopping conditioned on metric `x/y`" in err
    assert "Traceback" not in err
