"""What a test found in each image, written down, and the worst and the best of them drawn."""

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from lightning import LightningModule, Trainer

from posefilter.callbacks.gallery import ImageSelection, draw_gallery, find_shape, keep_image
from posefilter.callbacks.tensorboard import post_image
from posefilter.callbacks.trace_callback import TraceCallback
from posefilter.data.frames import FrameRecord
from posefilter.metrics.beliefs import on_object
from posefilter.metrics.collect import PoseErrors
from posefilter.metrics.image_errors import FILE, ImageError, write_errors
from posefilter.models.base import PoseEstimator
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
            error = (
                row.add_mm / 1000 if math.isfinite(row.diameter_mm) else 1 - row.particles_on_object
            )
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
                post_image(trainer, name, figure, self.folder / "figures", "test")


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
    add, add_s, diameter, up_to_symmetry = [[math.nan] * count] * 4
    if "pose" in method.capabilities:
        poses = method.scores["poses"]
        assert isinstance(poses, PoseErrors)
        add, add_s, diameter, up_to_symmetry = (1000 * poses.rows[-1]).T.tolist()
    shares = on_object(batch.mask, method.particle_pixels(trace.particles[-1], batch)).tolist()
    seconds = method.seconds_per_image[-1] if method.seconds_per_image else math.nan
    scores, times = trace.belief.score.tolist(), [seconds] * count
    judged = method.last_assessment(count)
    found = [judged.presence.tolist(), judged.probability.tolist()]
    if "pose" in method.capabilities:
        at_truth = method.scores["credibility"].last()
        found += [at_truth.log_density.tolist(), at_truth.rank.tolist(), up_to_symmetry]
    return make_rows(records, batch, add, add_s, diameter, shares, scores, times, *found)


def make_rows(
    records: Sequence[FrameRecord], batch: Batch, *columns: Sequence[float]
) -> list[ImageError]:
    """Return a row an image; columns: B numbers each, of the fields from `add_mm` on."""
    seen = batch.visibility.tolist()
    return [
        ImageError(r.scene_id, r.im_id, r.obj_id, r.object, r.name, *numbers)
        for r, *numbers in zip(records, seen, *columns, strict=True)
    ]
