"""What is seen on the console while a method trains."""

import sys
import time

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar, RichProgressBar


def progress(console: str) -> Callback:
    """Return the progress display: "rich" bars on a terminal, else ("plain", or no terminal) a line at each validation."""
    return StepBar(leave=True) if console == "rich" and sys.stdout.isatty() else PlainProgress()


def is_bar(shown: Callback) -> bool:
    """Tell whether a display is a bar, as Lightning's trainer wants to know."""
    return isinstance(shown, ProgressBar)


class StepBar(RichProgressBar):
    """Lightning's bar; runs are counted in steps here, and their number of epochs is nobody's choice."""

    def _get_train_description(self, current_epoch: int) -> str:
        return f"epoch {current_epoch}, step {self.trainer.global_step} of {self.trainer.max_steps}"


class PlainProgress(Callback):
    """One line at each validation: step, loss, score, speed."""

    def __init__(self) -> None:
        self._began, self._step = 0.0, 0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock."""
        self._began, self._step = time.perf_counter(), trainer.global_step

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Print the line."""
        if trainer.sanity_checking:
            return
        seen = trainer.callback_metrics
        rate = (trainer.global_step - self._step) / max(time.perf_counter() - self._began, 1e-9)
        told = [f"{name} {float(seen[name]):.4g}" for name in ("train/total", "val/score", "val/iou") if name in seen]
        print(f"step {trainer.global_step}: {', '.join(told)}, {rate:.2f} steps/s", flush=True)
