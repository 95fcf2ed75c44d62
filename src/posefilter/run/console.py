"""What is seen on the console while a method trains."""

import sys
import time

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import RichProgressBar


def progress(console: str) -> Callback:
    """Return the progress display: "rich" bars on a terminal, else ("plain", or no terminal) a line at each validation."""
    return RichProgressBar(leave=True) if console == "rich" and sys.stdout.isatty() else PlainProgress()


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
