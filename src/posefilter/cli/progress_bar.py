"""What is seen on the console while a method trains or is tested."""

import math
import sys
import time
from typing import Any

from lightning import Callback, LightningModule, Trainer
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from posefilter.cli.console import JSON, say
from posefilter.metrics.registry import find_metric
from posefilter.report.diagnostics import format_duration

SHOWN = ("train/loss", "val/add/auc", "val/add/median_mm", "val/iou", "val/particles_on_object")


def progress(console: str) -> Callback:
    """Return the progress display: "rich" bars on a terminal, else lines ("json": as JSON)."""
    return Bars() if console != JSON and sys.stdout.isatty() else Lines(console)


def format_metrics(metrics: dict[str, Any]) -> str:
    """Return the metrics that matter in words: `loss 1.25, ADD AUC 71.0`."""
    known = [(find_metric(name), float(metrics[name])) for name in SHOWN if name in metrics]
    return ", ".join(f"{info.short or info.label} {info.describe(value)}" for info, value in known)


def briefly(metrics: dict[str, Any]) -> str:
    """Return the two that fit beside a bar: the loss, and how well it finds the object."""
    finds = "val/add/auc" if "val/add/auc" in metrics else "val/particles_on_object"
    return format_metrics({k: metrics[k] for k in ("train/loss", finds) if k in metrics})


def count_steps(trainer: Trainer) -> int | None:
    """Return how many steps a training has, by its epochs too; None: only the clock ends it."""
    steps = trainer.estimated_stepping_batches
    return int(steps) if math.isfinite(steps) else None


def measure_done(trainer: Trainer, module: LightningModule, steps: int) -> float:
    """Return the share of a training that is done, by its steps or by its time budget, whichever is
    more: the budget may end it before its last step.
    """
    return max(trainer.global_step / steps, float(getattr(module, "time_spent", 0.0)))


class Lines(Callback):
    """A line at each validation; in a training or a test a sign of life every `pause` seconds: how
    far, how long still.
    """

    def __init__(self, console: str = "rich", pause: float = 60.0) -> None:
        self.console, self.pause = console, pause
        self._began, self._step, self._last = 0.0, 0, 0.0
        self._steps: int | None = None
        self._done: float | None = None  # share of the training, by earlier sittings

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock."""
        self._began, self._step = time.perf_counter(), trainer.global_step
        self._last, self._steps, self._done = self._began, count_steps(trainer), None

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Note the share that is done; the time budget, too, knows it by then."""
        if self._done is None and self._steps is not None:
            self._done = measure_done(trainer, pl_module, self._steps)

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Print a line where nothing was said for long."""
        if time.perf_counter() - self._last >= self.pause:
            loss = {k: v for k, v in trainer.callback_metrics.items() if k == "train/loss"}
            self._tell("training", trainer, pl_module, loss)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Print the line."""
        if not trainer.sanity_checking:
            self._tell("validation", trainer, pl_module, trainer.callback_metrics)

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock again."""
        self._began = self._last = time.perf_counter()

    def on_test_batch_end(self, trainer: Trainer, pl_module: LightningModule, *past: Any) -> None:
        """Print a line where nothing was said for long."""
        now = time.perf_counter()
        if now - self._last < self.pause:
            return
        self._last, done, batches = now, int(past[2]) + 1, sum(map(int, trainer.num_test_batches))
        left = format_duration((now - self._began) / done * (batches - done))
        sentence = f"batch {done} of {batches}: {left} left"
        say(self.console, "testing", sentence, batch=done, batches=batches)

    def _tell(
        self, event: str, trainer: Trainer, module: LightningModule, seen: dict[str, Any]
    ) -> None:
        step, steps, self._last = trainer.global_step, self._steps, time.perf_counter()
        elapsed = max(self._last - self._began, 1e-9)
        rate = (step - self._step) / elapsed
        pace = f"{rate:.2f} steps/s"
        if steps is not None and self._done is not None:
            done = measure_done(trainer, module, steps)
            if self._done < done < 1:
                left = elapsed * (1 - done) / (done - self._done)
                pace += f", {format_duration(left)} left"
        words = ", ".join(part for part in (format_metrics(seen), pace) if part)
        numbers: dict[str, float | None] = {"step": step, "steps": steps}
        for name, value in seen.items():
            if name == "train/loss" or (name.startswith("val/") and "/by_" not in name):
                numbers[name] = float(value)
        numbers["steps_per_second"] = rate
        place = f"step {step}" if steps is None else f"step {step} of {steps}"
        say(self.console, event, f"{place}: {words}", **numbers)


class Bars(Callback):
    """A bar over the training's steps, with loss and last figures; one a validation or test."""

    def __init__(self) -> None:
        self._bars: Progress | None = None
        self._training: TaskID | None = None
        self._steps: int | None = None
        self._looking: TaskID | None = None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Open the bar."""
        self._steps = count_steps(trainer)
        self._training = self._shown().add_task(
            "training", total=self._steps, completed=trainer.global_step, said=""
        )

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Move the bar; figures are fetched from the device as seldom as they are logged."""
        if self._training is None:
            return
        said: dict[str, Any] = {}
        every: int = trainer.log_every_n_steps  # type: ignore[attr-defined]
        logged = every > 0 and trainer.global_step % every == 0
        if logged or trainer.global_step == trainer.max_steps:
            said = {"said": briefly(trainer.callback_metrics)}
        step = trainer.global_step
        if self._steps is not None:
            step = round(self._steps * measure_done(trainer, pl_module, self._steps))
        self._shown().update(self._training, completed=step, **said)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Open a bar for the validation."""
        if not trainer.sanity_checking:
            self._look("validation", sum(map(int, trainer.num_val_batches)))

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Put a line in its place."""
        if self._looking is not None:
            self._shown().remove_task(self._looking)
            self._looking = None
        if not trainer.sanity_checking:
            said = f"step {trainer.global_step}: {format_metrics(trainer.callback_metrics)}"
            self._shown().console.print(said, highlight=False)

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Open a bar for the test."""
        self._look("test", sum(map(int, trainer.num_test_batches)))

    def _look(self, what: str, batches: int) -> None:
        self._looking = self._shown().add_task(what, total=batches, said="")

    def _advance(self, *_: Any, **__: Any) -> None:
        if self._looking is not None:
            self._shown().advance(self._looking)

    def _shown(self) -> Progress:
        if self._bars is None:
            self._bars = Progress(
                TextColumn("{task.description}"),
                BarColumn(24),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TimeRemainingColumn(),
                TextColumn("[dim]{task.fields[said]}"),
            )
            self._bars.start()
        return self._bars

    def _stop(self, *_: Any, **__: Any) -> None:
        if self._bars is not None:
            self._bars.stop()  # which leaves the terminal as it was
        self._bars = self._training = self._looking = None

    on_validation_batch_end = on_test_batch_end = _advance
    on_exception = teardown = _stop
