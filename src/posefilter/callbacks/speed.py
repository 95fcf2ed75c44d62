"""How fast a run goes, and what it waits for."""

import time
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer

from posefilter.callbacks.tensorboard import Budget, log_numbers


class Speed(Callback):
    """Log `speed/...`: images and steps a second, the share of the training that waits for data,
    and what validations take.

    Training's numbers are means since they were last logged, every `log_every_n_steps` steps;
    validations and the writing of checkpoints are left out of them. drawing_fraction: what other
    callbacks' figures have taken so far, over the time of all validations without them.
    """

    def __init__(self) -> None:
        self._images = self._steps = self._seen = self._first = 0
        self._waited = self._worked = 0.0
        self._mark: float | None = None  # when the last batch ended
        self._wrote = 0.0  # what checkpoints had taken by then
        self._began = 0.0  # the batch, or the validation

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Count from the step that a resumed training begins at."""
        self._first = trainer.global_step

    def on_train_batch_start(self, trainer: Trainer, *_: Any) -> None:
        """Count the time since the last batch as waiting, but for what checkpoints took, which
        Lightning has written last.
        """
        self._began = time.perf_counter()
        if self._mark is not None:
            wrote = measure_writing(trainer) - self._wrote
            self._waited += max(self._began - self._mark - wrote, 0.0)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, *_: Any
    ) -> None:
        """Count the batch, and log from time to time."""
        self._mark, self._wrote = time.perf_counter(), measure_writing(trainer)
        self._worked += self._mark - self._began
        self._images += len(batch[0])
        self._steps = trainer.global_step - self._first
        every: int = trainer.log_every_n_steps  # type: ignore[attr-defined]  # the logger connector sets it
        if 0 < every <= self._steps:
            self.write_down(trainer, self.training() | measure_memory(pl_module.device))
            self._images, self._first = 0, trainer.global_step
            self._waited = self._worked = 0.0

    def training(self) -> dict[str, float]:
        """Return the numbers since they were last logged."""
        total = max(self._waited + self._worked, 1e-9)
        return {
            "train_images_per_second": self._images / total,
            "train_steps_per_second": self._steps / total,
            "waiting_fraction": self._waited / total,
        }

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock of a validation."""
        self._began, self._seen = time.perf_counter(), 0

    def on_validation_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, *_: Any
    ) -> None:
        """Count images."""
        self._seen += len(batch[0])

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log what the validation took."""
        now = time.perf_counter()
        self._mark = None if self._mark is None else now
        self._wrote = measure_writing(trainer)
        if trainer.sanity_checking:
            return
        seconds = max(now - self._began, 1e-9)
        others: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        budgets = [b for c in others if isinstance(b := getattr(c, "budget", None), Budget)]
        numbers = {
            "validation_seconds": seconds,
            "validation_images_per_second": self._seen / seconds,
        }
        if budgets:
            numbers["drawing_fraction"] = sum(b.drawn for b in budgets) / max(
                max(b.validated for b in budgets), 1e-9
            )
        self.write_down(trainer, numbers)

    def write_down(self, trainer: Trainer, numbers: dict[str, float]) -> None:
        """Hand numbers to the loggers."""
        if trainer.is_global_zero:
            log_numbers(trainer, {f"speed/{name}": value for name, value in numbers.items()})


def measure_writing(trainer: Trainer) -> float:
    """Return how long the writing of checkpoints has taken so far [s], where that is counted."""
    return float(getattr(trainer.strategy.checkpoint_io, "seconds", 0.0))


def measure_memory(device: torch.device) -> dict[str, float]:
    """Return the most memory that was taken on a GPU so far; nothing of a CPU."""
    if device.type != "cuda":
        return {}
    return {"peak_memory_gib": torch.cuda.max_memory_allocated(device) / 2**30}
