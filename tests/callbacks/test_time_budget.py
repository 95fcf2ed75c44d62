"""A training with a time budget ends on time, and its schedule with it."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from lightning import LightningModule, Trainer
from torch import nn
from torch.optim.lr_scheduler import OneCycleLR
from torch.utils.data import DataLoader, TensorDataset

from posefilter.callbacks import time_budget
from posefilter.callbacks.time_budget import TimeBudget
from posefilter.errors import UserError
from posefilter.models.lr_schedulers import warmup_cosine


class Line(LightningModule):
    """A line, with the schedule of a training of `steps` steps."""

    def __init__(
        self, steps: int, clock: list[float], seconds: Callable[[int], float], one_cycle: bool
    ) -> None:
        super().__init__()
        self.layer, self.steps, self.clock = nn.Linear(1, 1), steps, clock
        self.seconds, self.one_cycle = seconds, one_cycle
        self.rates: list[float] = []
        self.time_spent, self.spent = 0.0, list[float]()  # the budget's share, at each step
        self.validations = 0

    def training_step(self, batch: list[torch.Tensor], _: int) -> torch.Tensor:
        self.clock[0] += self.seconds(self.global_step)
        self.spent.append(self.time_spent)
        self.rates.append(self.optimizers().param_groups[0]["lr"])  # type: ignore[union-attr]
        return self.layer(batch[0]).square().mean()

    def validation_step(self, batch: list[torch.Tensor], _: int) -> None:
        self.validations += 1

    def configure_optimizers(self) -> dict:  # type: ignore[override]
        optimizer = torch.optim.SGD(self.parameters(), lr=1.0)
        scheduler = (
            OneCycleLR(optimizer, 1.0, total_steps=self.steps)
            if self.one_cycle
            else warmup_cosine(optimizer, self.steps)
        )
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": scheduler, "interval": "step"},
        }


def run(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    steps: int,
    budget: TimeBudget,
    seconds: Callable[[int], float] = lambda _: 1.0,
    one_cycle: bool = False,
    **more: object,
) -> Line:
    clock = [0.0]
    name = {"wall": "perf_counter", "cpu": "process_time"}[budget.clock]
    monkeypatch.setattr(time_budget.time, name, lambda: clock[0])
    line = Line(steps, clock, seconds, one_cycle)
    data = DataLoader(TensorDataset(torch.ones(4, 1)), batch_size=1)
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
    budget = TimeBudget(8.0)
    line = run(tmp_path, monkeypatch, 20, budget)
    assert budget.ended
    assert len(line.rates) == 8
    assert line.rates[-1] < 0.1
    assert line.rates[1:] == sorted(line.rates[1:], reverse=True)
    assert line.validations == 4  # once, as after the last step


def test_a_schedule_that_was_advanced_is_not_taken_beyond_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # slow at first, so that the clock advances the schedule, and then as fast as was measured
    line = run(
        tmp_path,
        monkeypatch,
        20,
        TimeBudget(20.0),
        seconds=lambda step: 4.0 if step < 3 else 0.5,
        one_cycle=True,  # raises where it is taken further
    )
    assert 3 < len(line.rates) < 20
    assert line.rates[-1] < 0.01


def test_stages_of_the_losses_keep_pace_with_the_clock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = run(tmp_path, monkeypatch, 20, TimeBudget(8.0), stop=4)
    assert line.spent == [0.0, 1 / 8, 2 / 8, 3 / 8]
    again = run(tmp_path, monkeypatch, 20, TimeBudget(8.0), resume=tmp_path / "last.ckpt")
    assert again.spent == [4 / 8, 5 / 8, 6 / 8, 7 / 8]  # and not by its steps, of 20


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


@pytest.mark.parametrize("steps", [12, 20])
def test_the_fewest_steps_are_trained_whatever_they_take(
    steps: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the schedule ends with them: not before, and not long after."""
    budget = TimeBudget(8.0, fewest=12)
    line = run(tmp_path, monkeypatch, steps, budget)
    assert budget.ended
    assert len(line.rates) == 12
    assert line.rates[-1] < 0.1
    assert line.rates[1:] == sorted(line.rates[1:], reverse=True)
    assert line.spent == pytest.approx([step / 12 for step in range(12)])


def test_no_time_is_refused() -> None:
    with pytest.raises(UserError, match="must be positive"):
        TimeBudget(0.0)
