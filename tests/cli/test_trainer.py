"""What a trainer may be told."""

import warnings
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from posefilter.cli import run_command
from posefilter.cli.build import make_trainer, quiet
from posefilter.errors import UserError

HOME = Path(__file__).parents[2]
SETTINGS = {"_target_": "lightning.Trainer", "accelerator": "cpu", "max_steps": 1}


@pytest.mark.parametrize("precision", ["bf16-mixed", "16-true", "64-true"])
def test_a_precision_that_blurs_poses_is_refused(precision: str) -> None:
    with pytest.raises(UserError, match=rf"trainer\.precision={precision}: .*32-true"):
        make_trainer(OmegaConf.create({**SETTINGS, "precision": precision}), [])


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
