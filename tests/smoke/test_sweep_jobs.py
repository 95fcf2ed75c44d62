"""A sweep trains what it must, tests every job, and tells of those that failed."""

import csv
import json
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tests.smoke.conftest import HOME, SMALL_POSE_PF, TINY

from posefilter.cli import reuse, run_command
from posefilter.cli.folders import note_failure
from posefilter.cli.job import Job
from posefilter.errors import UserError


@pytest.mark.slow
def test_jobs_that_learn_the_same_are_trained_once_and_a_failed_one_is_reported(
    tiny_scenes: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    typed = [*TINY, f"data.root={tiny_scenes}", "trainer.max_steps=2", *SMALL_POSE_PF]
    typed += ["logger=tensorboard", "-m", "filter.particles=4,0,8", f"out={tmp_path}"]
    assert run_command("train", HOME, typed) == 2
    out, err = capfd.readouterr()
    assert err.splitlines()[-1] == f"train: 1 of 3 jobs failed: see {tmp_path}/summary.md"
    assert "Traceback" not in err

    with (tmp_path / "summary.csv").open() as file:
        first, second, failed = csv.DictReader(file)
    assert [row["filter.particles"] for row in (first, second, failed)] == ["4", "8", "0"]
    assert "filter.particles=0: must be a whole number, at least 1" in failed["error"]
    assert failed["iou"] == first["error"] == second["error"] == ""
    assert (tmp_path / "summary.png").is_file()

    events = [json.loads(line) for line in out.splitlines()]
    said = [event["event"] for event in events]
    assert said.count("validation") == said.count("reused") == 1
    assert events[-1]["failed"] == [failed["folder"]]

    runs = [tmp_path / row["folder"] for row in (first, second)]
    a, b = (torch.load(run / "checkpoints" / "best.ckpt", weights_only=True) for run in runs)
    assert all(torch.equal(value, b["state_dict"][key]) for key, value in a["state_dict"].items())
    assert b["recipe"]["settings"]["filter"]["particles"] == 8
    training = json.loads((runs[1] / "metrics.json").read_text())["training"]
    assert training["trained_as"] == first["folder"]
    assert training["steps"] == 2
    for run in runs:  # the one that is only tested, too
        logged = EventAccumulator(str(run), size_guidance={"images": 0}).Reload()
        tested = {event.step for event in logged.Scalars("test/add/auc")}
        assert tested == {event.step for event in logged.Images("6_test/worst")}
        assert tested == {training["tested_step"]}


@pytest.mark.slow
def test_what_a_sweep_found_stays_where_it_is_typed_again(
    tiny_scenes: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Without its data, and with data of other settings."""
    data, sweep = tmp_path / "data", tmp_path / "sweep"
    data.symlink_to(tiny_scenes)
    typed = [*TINY, "-m", "model=cnn_patch", "trainer.max_steps=2", f"out={sweep}", "seed=0,1"]
    assert run_command("train", HOME, [*typed, f"data.root={data}"]) == 0
    files = sorted(sweep.glob("*/metrics.json"))
    before = [file.read_bytes() for file in files]
    assert len(files) == 2
    data.unlink()
    capfd.readouterr()
    assert run_command("train", HOME, [*typed, f"data.root={data}"]) == 0
    events = [json.loads(line)["event"] for line in capfd.readouterr().out.splitlines()]
    assert events == ["skipped", "skipped", "swept"]

    assert run_command("train", HOME, [*typed, f"data.root={tiny_scenes}"]) == 1
    err = capfd.readouterr().err
    assert "holds results of other settings" in err
    assert err.splitlines()[-1].startswith("train: 2 jobs failed; what their folders held before")
    assert [file.read_bytes() for file in files] == before
    assert not list(sweep.rglob("failed.json"))


def test_a_job_whose_results_are_damaged_counts_as_failed(tmp_path: Path) -> None:
    job = Job(OmegaConf.create({}), {}, ["seed=1"], tmp_path, "train", True)
    (tmp_path / "metrics.json").write_text("{")
    assert note_failure(job, "damaged")
    assert json.loads((tmp_path / "failed.json").read_text())["error"] == "damaged"
    (tmp_path / "metrics.json").write_text('{"iou": 1}')
    assert not note_failure(job, "another")


def test_a_job_that_was_cut_short_with_other_settings_is_not_gone_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its folder is named by what was typed, which says neither `debug=` nor a changed default."""
    settings = {"model": {"net": {"width": 8}}, "seed": 1}
    then = {"choices": {"loss": "bce"}, "settings": settings}
    now = {"choices": {"loss": "bce"}, "settings": {**settings, "model": {"net": {"width": 64}}}}
    written = {"recipe": then, "global_step": 3}
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "last.ckpt").touch()
    monkeypatch.setattr(reuse, "read_checkpoint", lambda file: written)
    cfg = OmegaConf.create({"resume": None, "console": "json"})
    job = Job(cfg, {}, ["seed=1"], tmp_path, "train", True)
    monkeypatch.setattr(reuse, "recipe", lambda job: then)
    assert reuse.start_from(job) == (tmp_path / "checkpoints" / "last.ckpt", 3)
    monkeypatch.setattr(reuse, "recipe", lambda job: now)
    with pytest.raises(UserError, match=r"cut short, .* than now \(model.net.width\); delete it"):
        reuse.start_from(job)
    cfg.resume = str(tmp_path)  # what may change is checked where it is typed
    assert reuse.start_from(job)[1] == 3
