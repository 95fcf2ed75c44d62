"""A training with a time budget ends on time, and its schedule with it."""

from pathlib import Path

import pytest
import torch
from lightning import LightningModule, Trainer
from torch import nn
from torch.utils.data import DataLoader, TensorDataset

from posefilter.callbacks import time_budget
from posefilter.callbacks.time_budget import TimeBudget
from posefilter.errors import UserError
from posefilter.models.lr_schedulers import warmup_cosine


class Line(LightningModule):
    """A line, with the schedule of a training of `steps` steps; each step takes a second."""

    def __init__(self, steps: int, clock: list[float]) -> None:
        super().__init__()
        self.layer, self.steps, self.clock = nn.Linear(1, 1), steps, clock
        self.rates: list[float] = []
        self.validations = 0

    def training_step(self, batch: list[torch.Tensor], _: int) -> torch.Tensor:
        self.clock[0] += 1.0
        self.rates.append(self.optimizers().param_groups[0]["lr"])  # type: ignore[union-attr]
        return self.layer(batch[0]).square().mean()

    def validation_step(self, batch: list[torch.Tensor], _: int) -> None:
        self.validations += 1

    def configure_optimizers(self) -> dict:  # type: ignore[override]
        optimizer = torch.optim.SGD(self.parameters(), lr=1.0)
        scheduler = warmup_cosine(optimizer, self.steps)
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": scheduler, "interval": "step"},
        }


def run(
    folder: Path, monkeypatch: pytest.MonkeyPatch, steps: int, budget: TimeBudget, **more: object
) -> Line:
    clock = [0.0]
    name = {"wall": "perf_counter", "cpu": "process_time"}[budget.clock]
    monkeypatch.setattr(time_budget.time, name, lambda: clock[0])
    line, data = Line(steps, clock), DataLoader(TensorDataset(torch.ones(4, 1)), batch_size=1)
    trainer = Trainer(
        default_root_dir=folder,
        max_steps=int(more.get("stop", steps)),  # type: ignore[call-overload]
        val_check_interval=steps,
        check_val_every_n_epoch=None,
        num_sanity_val_steps=0,
        callbacks=[budget],
        logger=False,
        accelerator="cpu",
        enable_progress_bar=False,
        enable_model_summary=False,
        enable_checkpointing=False,
    )
    trainer.fit(line, data, data, ckpt_path=more.get("resume"), weights_only=True)  # type: ignore[arg-type]
    trainer.save_checkpoint(folder / "last.ckpt")
    return line


def test_a_fast_machine_sees_the_schedule_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = run(tmp_path, monkeypatch, 20, TimeBudget(100.0))
    rise = warmup_cosine(torch.optim.SGD(line.parameters(), lr=1.0), 20)
    assert len(line.rates) == 20
    assert line.rates == pytest.approx([rise.lr_lambdas[0](step) for step in range(20)])


def test_a_slow_machine_ends_on_time_with_the_rate_decayed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = run(tmp_path, monkeypatch, 20, TimeBudget(8.0))
    assert len(line.rates) == 8
    assert line.rates[-1] < 0.1
    assert line.rates[1:] == sorted(line.rates[1:], reverse=True)
    assert line.validations == 4  # once, as after the last step


def test_processor_time_is_a_clock_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = run(tmp_path, monkeypatch, 20, TimeBudget(8.0, clock="cpu"))
    assert len(line.rates) == 8
    with pytest.raises(UserError, match="clock sun: choose wall or cpu"):
        TimeBudget(8.0, clock="sun")


def test_time_of_an_earlier_sitting_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = run(tmp_path, monkeypatch, 20, TimeBudget(10.0), stop=4)
    assert len(first.rates) == 4
    second = run(tmp_path, monkeypatch, 20, TimeBudget(10.0), resume=tmp_path / "last.ckpt")
    assert len(second.rates) == 6


def test_no_time_is_refused() -> None:
    with pytest.raises(UserError, match="must be positive"):
        TimeBudget(0.0)
