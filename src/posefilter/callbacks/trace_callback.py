"""The base class of callbacks that are given the filter's traces."""

from pathlib import Path
from typing import Any, cast

from lightning import Callback, LightningModule, Trainer

from posefilter.models.base import PoseEstimator
from posefilter.types import Batch, Trace


class TraceCallback(Callback):
    """Hands the trace of each validation and test batch to a method that a subclass overrides.

    Batches of the sanity check, and steps that return no trace, are left out.

    Args:
        folder: Where files are written; None: nowhere.
    """

    def __init__(self, folder: str | Path | None = None) -> None:
        self.folder = None if folder is None else Path(folder)

    def on_validation_trace(
        self, trainer: Trainer, method: PoseEstimator, trace: Trace, batch: Batch
    ) -> None:
        """Take in one batch of a validation."""

    def on_test_trace(
        self, trainer: Trainer, method: PoseEstimator, trace: Trace, batch: Batch, number: int
    ) -> None:
        """Take in one batch of a test, of this number."""

    def on_validation_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, *_: Any
    ) -> None:
        """Hand the trace on."""
        if isinstance(outputs, Trace) and not trainer.sanity_checking:
            self.on_validation_trace(trainer, cast(PoseEstimator, pl_module), outputs, batch)

    def on_test_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        *_: Any,
    ) -> None:
        """Hand the trace on."""
        if isinstance(outputs, Trace):
            method = cast(PoseEstimator, pl_module)
            self.on_test_trace(trainer, method, outputs, batch, batch_idx)
