"""What a trainer may be told."""

import signal
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import torch
from lightning.fabric.plugins.precision.precision import (
    _PRECISION_INPUT_INT,
    _PRECISION_INPUT_STR,
    _PRECISION_INPUT_STR_ALIAS,
)
from lightning.pytorch.accelerators import CPUAccelerator
from omegaconf import OmegaConf

from posefilter.cli import run_command
from posefilter.cli.build import list_swept, make_trainer, quiet
from posefilter.cli.evaluate import make_tester
from posefilter.cli.instantiate import instantiate
from posefilter.cli.job import Job
from posefilter.cli.ranks import check_others
from posefilter.cli.results import record
from posefilter.errors import ProblemsFound, UserError
from posefilter.precision import check_precision

HOME = Path(__file__).parents[2]
SETTINGS = {"_target_": "lightning.Trainer", "accelerator": "cpu", "max_steps": 1}
SLURM = {
    "SLURM_JOB_ID": "7", "SLURM_JOB_NAME": "box", "SLURM_NTASKS": "1", "SLURM_PROCID": "0",
    "SLURM_LOCALID": "0", "SLURM_NODEID": "0",
}  # fmt: skip


@pytest.fixture
def in_slurm(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in SLURM.items():
        monkeypatch.setenv(name, value)


def test_what_all_jobs_of_a_sweep_share_is_not_swept(tmp_path: Path) -> None:
    """Neither what was typed of all, nor a choice of one value."""
    words = ["budget=short", "tags=[a,b]", "filter.particles=50", "model.net.width=16", "seed=1"]
    job = Job(OmegaConf.create({}), {}, words, tmp_path / "job", "train", True)
    assert list_swept(job) == tuple(word.partition("=")[0] for word in words)  # not known
    task = ["budget=short", "tags=[a,b]", "filter.particles=50,100", "model.net.width=choice(16)"]
    sweeper = {"params": {"seed": "range(0,3)"}}
    OmegaConf.save(
        {"hydra": {"sweeper": sweeper, "overrides": {"task": task}}}, tmp_path / "multirun.yaml"
    )
    assert set(list_swept(job)) == {"filter.particles", "seed"}
    assert list_swept(replace(job, swept=False)) == ()


@pytest.mark.usefixtures("in_slurm")
def test_a_job_of_slurm_is_not_started_anew_behind_the_users_back() -> None:
    """At SIGUSR1 Lightning's own handler calls `scontrol requeue`."""
    connector = make_trainer(OmegaConf.create({**SETTINGS}), [])._signal_connector
    before = signal.getsignal(signal.SIGUSR1)
    connector.register_signal_handlers()
    try:
        assert signal.getsignal(signal.SIGUSR1) == before
    finally:
        connector.teardown()


@pytest.mark.usefixtures("in_slurm")
def test_a_checkpoint_that_would_be_tested_in_place_of_the_best_is_told(tmp_path: Path) -> None:
    """Lightning looks for one of that name in a job of Slurm, and loads it before a test."""
    settings = OmegaConf.create({**SETTINGS, "default_root_dir": str(tmp_path)})
    make_trainer(settings, [])
    (tmp_path / "hpc_ckpt_1.ckpt").touch()
    with pytest.raises(UserError, match=r"hpc_ckpt_1\.ckpt: in a job of Slurm .* move it away"):
        make_trainer(settings, [])


def test_one_of_several_processes_does_not_train_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would write no results, and end as if all were well."""
    monkeypatch.setattr("posefilter.cli.build.is_follower", lambda: True)
    with pytest.raises(UserError, match=r"trainer\.devices=1: this is one of several processes"):
        make_trainer(OmegaConf.create({**SETTINGS, "devices": 1}), [])
    strategy = {"devices": 2, "strategy": "ddp"}
    assert make_trainer(OmegaConf.create({**SETTINGS, **strategy}), []).world_size == 2


@pytest.mark.parametrize("typed", ["trainer.devices=2", "+trainer.num_nodes=2"])
def test_a_test_in_several_processes_is_refused_before_any_other_is_started(
    typed: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Lightning ends all by SIGKILL once the second is refused as one too many."""
    words = [typed, "checkpoint=none.ckpt", f"out={tmp_path / 'x'}"]
    assert run_command("evaluate", HOME, words) == 2
    message = f"{typed.removeprefix('+')}: evaluate tests in one process; leave it at 1"
    assert capfd.readouterr().err == f"evaluate: {message}\n"


def test_a_test_on_all_devices_is_refused_where_there_are_several(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`auto` is known once the machine was asked."""
    settings = OmegaConf.create({**SETTINGS, "devices": "auto"})
    assert make_tester(settings, []).world_size == 1
    monkeypatch.setattr(CPUAccelerator, "auto_device_count", staticmethod(lambda: 2))
    with pytest.raises(UserError, match=r"^trainer\.devices=auto: evaluate tests in one process"):
        make_tester(settings, [])


@pytest.mark.parametrize("strategy", ["ddp_fork", "ddp_notebook", "ddp_spawn"])
@pytest.mark.parametrize("devices", [1, 2])
def test_a_strategy_whose_results_end_with_its_processes_is_refused(
    strategy: str, devices: int
) -> None:
    """Lightning then trains in copies of this process, which writes results of no image."""
    settings = OmegaConf.create({**SETTINGS, "strategy": strategy, "devices": devices})
    with pytest.raises(UserError, match=rf"^trainer\.strategy={strategy}: .*=ddp_find_unused_\w+"):
        make_trainer(settings, [])


@pytest.mark.parametrize(
    ("code", "how"),
    [
        ("import sys; sys.exit(1)", "exit status 1"),
        ("import os; os.kill(os.getpid(), 9)", "signal 9"),
    ],
)
def test_another_process_that_fails_after_the_training_is_told(code: str, how: str) -> None:
    """The first has its results by then, and would end with status 0."""
    others = [subprocess.Popen([sys.executable, "-c", one]) for one in ("", code)]
    with pytest.raises(ProblemsFound, match=rf"^process 2 of this training ended .*{how}, .*"):
        check_others(others)
    check_others(others[:1])


def test_another_process_that_is_still_at_its_test_is_left_alone() -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as late:
        check_others([late], wait=0.1)
        assert late.poll() is None
        late.communicate(b"\n")


def test_no_results_are_written_of_no_image() -> None:
    job = Job(OmegaConf.create({}), {}, [], Path(), "train", False)
    with pytest.raises(UserError, match=r"^no image was tested"):
        record({"instances": 0, "missed": 0}, job, {}, None)
    assert record({"instances": 1, "missed": 0}, job, {}, None)["instances"] == 1


@pytest.mark.parametrize("precision", ["bf16-mixed", "16-true", "64-true"])
def test_a_precision_that_blurs_poses_is_refused(precision: str) -> None:
    with pytest.raises(UserError, match=rf"trainer\.precision={precision}: .*32-true"):
        make_trainer(OmegaConf.create({**SETTINGS, "precision": precision}), [])


def test_a_precision_that_there_is_not_is_told_from_one_that_blurs_poses() -> None:
    """Lightning's own lists say which there are."""
    lists = _PRECISION_INPUT_INT, _PRECISION_INPUT_STR, _PRECISION_INPUT_STR_ALIAS
    for there in (one for names in lists for one in get_args(names)):
        if str(there) not in ("32", "32-true"):
            with pytest.raises(UserError, match=rf"^trainer\.precision={there}: half precision"):
                check_precision(there)
    for absent in (17, "double", "32-mixed"):
        told = rf"^trainer\.precision={absent}: Lightning has none of this name; .*32-true"
        with pytest.raises(UserError, match=told):
            check_precision(absent)


def test_a_callback_that_may_not_be_built_is_told_which_may() -> None:
    name = "lightning.pytorch.callbacks.RichProgressBar"
    told = r"^callbacks\.bar\._target_=.*RichProgressBar: is not on the list .*EarlyStopping, "
    with pytest.raises(UserError, match=told):
        instantiate({"bar": {"_target_": name}}, "callbacks")


def test_full_precision_is_taken() -> None:
    assert (
        make_trainer(OmegaConf.create({**SETTINGS, "precision": "32-true"}), []).precision
        == "32-true"
    )


def test_the_device_is_chosen_as_everywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("posefilter.cli.build.choose_device", lambda: "cpu")
    monkeypatch.setattr("torch.backends.mps.is_available", lambda: True)
    trainer = make_trainer(OmegaConf.create({**SETTINGS, "accelerator": "auto"}), [])
    assert trainer.strategy.root_device.type == "cpu"


def test_advice_on_several_processes_that_does_not_apply_is_silent() -> None:
    """Each validates all images: there is nothing to be added up."""
    with warnings.catch_warnings(record=True) as said:
        quiet()
        warnings.warn(  # as Lightning does for each number
            "It is recommended to use `self.log('val/iou', ..., sync_dist=True)` when logging on "
            "epoch level in distributed setting to accumulate the metric across devices.",
            stacklevel=1,
        )
    assert said == []


@pytest.mark.slow
def test_a_training_without_end_needs_no_schedule(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ["debug=smoke", "model=pixel_pf", f"data.root={tmp_path / 'data'}", "console=json"]
    words += ["trainer.max_steps=-1", "logger=none", f"out={tmp_path / 'run'}"]
    assert run_command("train", HOME, words) == 2
    assert "trainer.max_steps=-1: the learning rate's schedule" in capfd.readouterr().err


def test_a_gpu_without_memory_is_told_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def fill(job: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 9 GiB")

    monkeypatch.setattr("posefilter.cli.generate.generate", fill)
    assert run_command("generate", HOME, [f"out={tmp_path / 'x'}"]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("generate: out of memory")
