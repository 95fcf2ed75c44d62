"""Figures of each validation, into TensorBoard and the run's folder: callbacks/drawings.py says
which there are.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import torch
from lightning import LightningModule, Trainer
from torch import Tensor

from posefilter.callbacks.drawings import DRAWINGS, Occasion
from posefilter.callbacks.gallery import (
    ImageSelection,
    KeptImage,
    compute_errors,
    find_shape,
    keep_image,
    name_frame,
    select_image,
)
from posefilter.callbacks.tensorboard import BudgetedCallback, post_image
from posefilter.data.absent import hide_annotation
from posefilter.errors import UserError
from posefilter.geometry.pose_error import subsample
from posefilter.models.base import PoseEstimator
from posefilter.types import Batch, Trace


class Figures(BudgetedCallback):
    """Draw figures of validations, into TensorBoard and `folder`.

    Neither the method nor any random generator is changed.

    Args:
        folder: Where files are written; None: TensorBoard alone.
        every_n_validations: Validations between figures.
        first: The first images that are kept.
        best: The best images that are kept.
        worst: The worst images that are kept.
        exclude: Names of figures that are not drawn.
        max_time_fraction: Largest fraction of the validations' time that drawing takes; None: no
            limit. Drawing that would take more is put off to a later validation, or to the end of
            the training.

    Raises:
        UserError: `exclude` names a figure that does not exist.
    """

    def __init__(
        self,
        folder: str | Path | None = None,
        every_n_validations: int = 1,
        first: int = 5,
        best: int = 10,
        worst: int = 10,
        exclude: Sequence[str] = (),
        max_time_fraction: float | None = 0.04,
    ) -> None:
        unknown = sorted(set(exclude) - set(DRAWINGS))
        if unknown:
            raise UserError(
                f"callbacks.figures.exclude={unknown[0]}: there is no such figure; there are "
                f"{', '.join(DRAWINGS)}"
            )
        super().__init__(folder, max_time_fraction)
        self.every_n_validations = every_n_validations
        self.counts = {"first": first, "best": best, "worst": worst}
        self.drawings = {name: draw for name, draw in DRAWINGS.items() if name not in exclude}
        self._validations = 0
        self._selection = ImageSelection(**self.counts)
        self._example: tuple[KeptImage, Trace, Batch] | None = None
        self._points: Tensor | None = None

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Forget the last validation."""
        self._selection, self._example, self._points = ImageSelection(**self.counts), None, None
        super().on_validation_epoch_start(trainer, pl_module)

    def on_validation_trace(
        self, trainer: Trainer, method: PoseEstimator, trace: Trace, batch: Batch
    ) -> None:
        """Keep the images that may be drawn."""
        if self._validations % self.every_n_validations:
            return
        if self._points is None:
            self._points = subsample(method.object_model.points, 256).to(batch.rgb.device)
        errors = compute_errors(trace, batch, method, self._points).tolist()
        for i, error in enumerate(errors):
            name = name_frame(trainer, "val", int(batch.frame_id[i]))
            self._selection.offer(error, partial(keep_image, trace, batch, method, i, error, name))
            if self._example is None:
                one = keep_image(trace, batch, method, i, error, name)
                alone = Batch(*(x[:1].clone() for x in batch))
                self._example = (one, select_image(trace, 0), alone)

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw, or put it off."""
        if trainer.sanity_checking:
            return
        self.budget.stop()
        self._validations += 1
        if self._example is None:
            return
        if trainer.is_global_zero:
            kept, step = self._selection.separate(), trainer.global_step
            assert isinstance(pl_module, PoseEstimator)
            self.budget.draw(partial(self._draw, trainer, pl_module, self._example, kept, step))

    def _draw(
        self,
        trainer: Trainer,
        method: PoseEstimator,
        example: tuple[KeptImage, Trace, Batch],
        kept: dict[str, list[KeptImage]],
        step: int,
    ) -> None:
        one, trace, batch = example
        with evaluate_quietly(method):
            batch = Batch(*(x.to(method.device) for x in batch))
            shape, encoding = find_shape(trainer, method), method.encode(hide_annotation(batch))
            when = f"step {step}"
            if trainer.global_step != step:  # it was put off, and the training went on
                when += f", networks of step {trainer.global_step}"
            occasion = Occasion(method, shape, kept, one, trace, batch, encoding, when)
            for name, drawing in self.drawings.items():
                drawn = drawing(occasion)
                if drawn is not None:
                    post_image(trainer, name, drawn, self.folder, step=step)


@contextmanager
def evaluate_quietly(method: PoseEstimator) -> Iterator[None]:
    """Have a method look at images as in a validation, and leave it as it was."""
    before = [(module, module.training) for module in method.modules()]
    method.eval()
    try:
        with torch.no_grad():
            yield
    finally:
        for module, training in before:
            module.training = training
