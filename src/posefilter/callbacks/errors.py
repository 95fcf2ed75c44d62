"""What a test found in each image, written down, and the worst and the best of them drawn."""

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from lightning import LightningModule, Trainer

from posefilter.callbacks.gallery import ImageSelection, draw_gallery, find_shape, keep_image
from posefilter.callbacks.tensorboard import post_image
from posefilter.callbacks.trace_callback import TraceCallback
from posefilter.data.frames import FrameRecord
from posefilter.metrics.beliefs import on_object
from posefilter.metrics.image_errors import FILE, ImageError, write_errors
from posefilter.metrics.scores import InstanceErrors
from posefilter.models.base import PoseEstimator
from posefilter.models.evaluation import last_assessment
from posefilter.types import Batch, Trace


class ErrorTable(TraceCallback):
    """Write `errors.csv`, a row an image of the test, and draw its worst and best images.

    Args:
        folder: The run's folder; figures go to `figures` in it. Nothing is written if None.
        best: How many images are drawn.
        worst: How many images are drawn.
    """

    def __init__(self, folder: str | Path | None = None, best: int = 6, worst: int = 9) -> None:
        super().__init__(folder)
        self.counts = {"first": 0, "best": best, "worst": worst}
        self.rows: list[ImageError] = []
        self._selection = ImageSelection(**self.counts)

    def on_test_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Forget an earlier test."""
        self.rows, self._selection = [], ImageSelection(**self.counts)

    def on_test_trace(
        self, trainer: Trainer, method: PoseEstimator, trace: Trace, batch: Batch, number: int
    ) -> None:
        """Take in one batch."""
        records: Sequence[FrameRecord] = trainer.datamodule.records("test")  # type: ignore[attr-defined]
        rows = measure_batch(method, trace, batch, [records[i] for i in batch.frame_id.tolist()])
        self.rows += rows
        for i, row in enumerate(rows):
            posed = math.isfinite(row.diameter_mm)
            error = row.error_mm / 1000 if posed else 1 - row.particles_on_object
            keep = partial(keep_image, trace, batch, method, i, error, row.image)
            self._selection.offer(error, keep)

    def on_test_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the table and the figures."""
        assert isinstance(pl_module, PoseEstimator)
        if self.folder is None or not trainer.is_global_zero:
            return
        write_errors(self.folder / FILE, self.rows)
        shape = find_shape(trainer, pl_module)
        chosen = self._selection.separate()
        for name in ("worst", "best"):
            kept = chosen[name]
            if kept:
                title = f"The {len(kept)} {name} images\nof {len(self.rows)} of the test"
                figure = draw_gallery(kept, shape, "pose" in pl_module.capabilities, title)
                folder, step = self.folder / "figures", pl_module.trained.step
                post_image(trainer, name, figure, folder, "test", step)


def measure_batch(
    method: PoseEstimator, trace: Trace, batch: Batch, records: Sequence[FrameRecord]
) -> list[ImageError]:
    """Return a row an image of a batch that a method has just been tested on.

    Args:
        method: Its metrics have taken in the batch.
        trace: What its filter did.
        batch: B images.
        records: The B frames.
    """
    count = len(records)
    errors = InstanceErrors(*torch.full((4, count), torch.nan))
    belief: dict[str, Sequence[float]] = {}
    if "pose" in method.capabilities:
        errors, truth = method.scores["poses"].last(), method.scores["credibility"].last()
        belief = {"log_density": truth.log_density.tolist(), "credible_rank": truth.rank.tolist()}
    pixels = method.particle_pixels(trace.particles[-1], batch)
    seconds = method.seconds_per_image[-1] if method.seconds_per_image else math.nan
    judged = last_assessment(method, count)
    return make_rows(
        records,
        batch,
        errors,
        particles_on_object=on_object(batch.mask, pixels).tolist(),
        score=trace.belief.score.tolist(),
        seconds=[seconds] * count,
        presence=judged.presence.tolist(),
        probability=judged.probability.tolist(),
        **belief,
    )


def make_rows(
    records: Sequence[FrameRecord],
    batch: Batch,
    errors: InstanceErrors,
    **columns: Sequence[float],
) -> list[ImageError]:
    """Return a row an image.

    Args:
        records: The B frames.
        batch: The B images.
        errors: (B,) each [m].
        **columns: Other fields of the rows, B numbers each.
    """
    for name, values in errors._asdict().items():
        columns[f"{name}_mm"] = (1000 * values).tolist()
    columns["visibility"] = batch.visibility.tolist()
    numbers = zip(*columns.values(), strict=True)
    return [
        ImageError(
            r.scene_id, r.im_id, r.obj_id, r.object, r.name, **dict(zip(columns, row, strict=True))
        )
        for r, row in zip(records, numbers, strict=True)
    ]
