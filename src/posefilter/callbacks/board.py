"""Hand pictures to TensorBoard and to the run's folder, and keep count of what drawing costs."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from lightning import Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.compat.proto.summary_pb2 import Summary

from posefilter.pictures.canvas import to_png


def post(trainer: Trainer, tag: str, picture: np.ndarray, file: Path | None) -> None:
    """Show a picture (H, W, 3) uint8 under a tag, at the trainer's step, and write it as PNG unless `file` is None.

    It is packed once for all: `add_image` would pack it again for each logger, slowly.
    """
    png = to_png(picture)
    image = Summary.Image(height=picture.shape[0], width=picture.shape[1], colorspace=3, encoded_image_string=png)
    for logger in trainer.loggers:
        if isinstance(logger, TensorBoardLogger):
            writer = logger.experiment._get_file_writer()
            writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), trainer.global_step)
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(png)


class Budget:
    """Lets drawing take at most a share of the time that validations take.

    share: None for no limit. The first drawing is always allowed, since nobody knows what it will cost.
    """

    def __init__(self, share: float | None) -> None:
        self.share = share
        self.validated, self.drawn, self.last = 0.0, 0.0, 0.0
        self._start = 0.0

    def start(self) -> None:
        """Start the clock of a validation."""
        self._start = time.perf_counter()

    def stop(self) -> None:
        """Stop it."""
        self.validated += time.perf_counter() - self._start

    def allows(self) -> bool:
        """Tell whether another drawing, as dear as the last one, stays within the share."""
        return self.share is None or self.last == 0 or self.drawn + self.last <= self.share * self.validated

    @contextmanager
    def spend(self) -> Iterator[None]:
        """Count what is done within."""
        start = time.perf_counter()
        yield
        self.last = time.perf_counter() - start
        self.drawn += self.last
