"""Hand figures to TensorBoard and to the run's folder, and keep count of what drawing costs."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import numpy as np
from lightning import LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from PIL import Image
from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard.writer import FileWriter

from posefilter.callbacks.trace_callback import TraceCallback
from posefilter.figures.canvas import to_jpeg
from posefilter.files import write_whole

# The order of the tab Images: what answers "does it work" comes first.
# What is in no group is only written to the run's folder.
GROUPS = {
    "overlays": "1_poses", "worst": "1_poses",
    "particles": "2_filter", "animation": "2_filter", "trajectories": "2_filter",
    "health": "2_filter",
    "belief": "3_belief",
    "field": "4_network", "proposals": "4_network", "objectness": "4_network",
    "glimpses": "4_network",
    "diagnostics": "5_diagnostics",
}  # fmt: skip
TEST = "6_test"


def name_tag(name: str, stage: str) -> str | None:
    """Return the tag of a figure, None where TensorBoard does not show it."""
    if stage == "test":
        return f"{TEST}/{name}"
    return f"{GROUPS[name]}/{name}" if name in GROUPS else None


def post_image(
    trainer: Trainer,
    name: str,
    drawn: np.ndarray | bytes,
    folder: Path | None,
    stage: str = "validation",
    step: int | None = None,
) -> None:
    """Show a figure in TensorBoard, and write it to a file.

    It is packed once for all: `add_image` would pack it again for each logger, slowly, and knows no
    animations.  As a JPEG: TensorBoard computes a checksum byte by byte in Python, which for a PNG
    takes longer than most figures take to draw.

    Args:
        trainer: Its TensorBoards are written to.
        name: Of the figure; `GROUPS` says where TensorBoard shows it.
        drawn: An image (H, W, 3) uint8, or an animation as the bytes of a GIF.
        folder: Where it is written as `<stage>_<name>`, nowhere if None.
        stage: "validation" or "test".
        step: Where TensorBoard shows it; None: at the trainer's.
    """
    packed, suffix = (drawn, ".gif") if isinstance(drawn, bytes) else (to_jpeg(drawn), ".jpg")
    tag = name_tag(name, stage)
    if tag is not None:
        width, height = Image.open(BytesIO(packed)).size
        image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=packed)
        for writer in get_writers(trainer):
            writer.add_summary(
                Summary(value=[Summary.Value(tag=tag, image=image)]),
                trainer.global_step if step is None else step,
            )
    if folder is not None:
        write_whole(folder / f"{stage}_{name}{suffix}", packed)


def log_numbers(trainer: Trainer, numbers: Mapping[str, float]) -> None:
    """Hand numbers to the trainer's loggers."""
    for logger in trainer.loggers:
        logger.log_metrics(dict(numbers), trainer.global_step)


def get_writers(trainer: Trainer) -> list[FileWriter]:
    """Return the writers of the trainer's TensorBoards."""
    return [board.experiment._get_file_writer() for board in get_boards(trainer)]


def get_boards(trainer: Trainer) -> list[TensorBoardLogger]:
    """Return the trainer's TensorBoards."""
    return [logger for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]


class Budget:
    """Lets drawing take at most a fraction of the time that validations take.

    max_fraction: None for no limit. The first drawing is always allowed, since nobody knows what
    it will cost.
    """

    def __init__(self, max_fraction: float | None) -> None:
        self.max_fraction = max_fraction
        self.validated, self.drawn, self.last = 0.0, 0.0, 0.0
        self._start = 0.0
        self._put_off: Callable[[], None] | None = None

    def start(self) -> None:
        """Start the clock of a validation."""
        self._start = time.perf_counter()

    def stop(self) -> None:
        """Stop it."""
        self.validated += time.perf_counter() - self._start

    def allows(self) -> bool:
        """Tell whether another drawing, as dear as the last one, stays within the limit."""
        return (
            self.max_fraction is None
            or self.last == 0
            or self.drawn + self.last <= self.max_fraction * self.validated
        )

    def draw(self, draw: Callable[[], None]) -> None:
        """Draw, or put it off: until a later drawing takes its place, or to `finish`."""
        self._put_off = draw
        if self.allows():
            self.finish()

    def finish(self) -> None:
        """Draw what was put off."""
        draw, self._put_off = self._put_off, None
        if draw is not None:
            with self.spend():
                draw()

    @contextmanager
    def spend(self) -> Iterator[None]:
        """Count what is done within."""
        start = time.perf_counter()
        yield
        self.last = time.perf_counter() - start
        self.drawn += self.last


class BudgetedCallback(TraceCallback):
    """Base of callbacks that draw validations, in a fraction of the time that these take.

    Args:
        folder: Where files are written; None: nowhere.
        max_time_fraction: The fraction; None: no limit.
    """

    def __init__(self, folder: str | Path | None, max_time_fraction: float | None) -> None:
        super().__init__(folder)
        self.budget = Budget(max_time_fraction)

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock."""
        self.budget.start()

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw the last validation, if that was put off."""
        self.budget.finish()
