"""Speed is counted by a clock that the test turns."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from posefilter.callbacks import speed
from posefilter.callbacks.speed import Speed
from posefilter.callbacks.tensorboard import Budget
from posefilter.cli.files import WholeCheckpoints


def test_images_waiting_and_validations_are_timed_separately(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [0.0]
    monkeypatch.setattr(speed.time, "perf_counter", lambda: now[0])
    logged: list[dict[str, float]] = []
    logger = SimpleNamespace(log_metrics=lambda numbers, step: logged.append(numbers))
    drawer = SimpleNamespace(budget=Budget(None))
    drawer.budget.validated, drawer.budget.drawn = 20.0, 1.0
    trainer: Any = SimpleNamespace(
        loggers=[logger],
        global_step=0,
        is_global_zero=True,
        sanity_checking=False,
        log_every_n_steps=4,
        callbacks=[drawer],
        strategy=SimpleNamespace(checkpoint_io=SimpleNamespace(seconds=0.0)),
    )
    method: Any = SimpleNamespace(device=torch.device("cpu"))
    callback, batch = Speed(), [[0] * 8]

    def step(wait: float) -> None:
        now[0] += wait
        callback.on_train_batch_start(trainer, method, batch, 0)
        now[0] += 3.0
        trainer.global_step += 1
        callback.on_train_batch_end(trainer, method, None, batch, 0)

    def write(seconds: float) -> None:
        now[0] += seconds
        trainer.strategy.checkpoint_io.seconds += seconds

    step(100.0)  # the first wait, for workers to start, is nobody's
    step(1.0)
    callback.on_validation_start(trainer, method)
    for _ in range(3):
        callback.on_validation_batch_end(trainer, method, None, batch, 0)
    now[0] += 48.0
    callback.on_validation_end(trainer, method)
    write(7.0)  # the best checkpoint
    step(1.0)
    write(20.0)
    step(1.0)
    validation, training = logged
    assert validation == {
        "speed/validation_seconds": 48.0,
        "speed/validation_images_per_second": 0.5,
        "speed/drawing_fraction": 0.05,
    }
    assert training["speed/train_images_per_second"] == pytest.approx(32 / 15)
    assert training["speed/train_steps_per_second"] == pytest.approx(4 / 15)
    assert training["speed/waiting_fraction"] == pytest.approx(3 / 15)


def test_what_is_never_logged_is_not_logged_at_each_step() -> None:
    logged: list[dict[str, float]] = []
    trainer: Any = SimpleNamespace(
        loggers=[SimpleNamespace(log_metrics=lambda numbers, step: logged.append(numbers))],
        global_step=1,
        is_global_zero=True,
        log_every_n_steps=0,
        strategy=SimpleNamespace(checkpoint_io=object()),  # one that counts no time
    )
    method: Any = SimpleNamespace(device=torch.device("cpu"))
    callback = Speed()
    for _ in range(3):
        callback.on_train_batch_start(trainer, method, [[0]], 0)
        trainer.global_step += 1
        callback.on_train_batch_end(trainer, method, None, [[0]], 0)
    assert not logged


def test_the_writing_of_checkpoints_is_timed(tmp_path: Path) -> None:
    writer, other = WholeCheckpoints(), WholeCheckpoints()
    writer.save_checkpoint({"state_dict": {}}, tmp_path / "a.ckpt")
    first = writer.seconds
    writer.save_checkpoint({"state_dict": {}}, tmp_path / "a.ckpt")
    assert 0 < first < writer.seconds
    assert other.seconds == 0
