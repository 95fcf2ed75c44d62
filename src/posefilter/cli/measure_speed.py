"""How long a step of a training and an image of its test take, measured before it begins."""

import shutil
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from lightning import Callback, LightningModule, Trainer

from posefilter.cli.job import Job
from posefilter.cli.train import build, look_once

_STEPS, _SKIPPED = 9, 3  # the first steps fill caches
_IMAGES = 3


class Speed(NamedTuple):
    """Of a training on this machine."""

    step: float  # the fastest of some, as what else runs here may end [s]
    image: float  # of the filter, the median of some [s]


class _Clock(Callback):
    """Take the time at the end of each step."""

    def __init__(self) -> None:
        self.times: list[float] = []

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Take it."""
        self.times.append(time.perf_counter())


def measure_speed(job: Job) -> Speed:
    """Measure a training by some steps that are thrown away, with all that it wrote.

    Args:
        job: Its trainer writes into a folder that is removed.
    """
    cfg = job.cfg.copy()
    cfg.trainer.max_steps = cfg.trainer.val_check_interval = _STEPS
    cfg.trainer.limit_val_batches = 0
    cfg.callbacks, cfg.logger = {}, {}
    enough = (_STEPS + 1) * cfg.data.batch_size  # frames that are decoded for it
    cfg.data.limit_train = min(enough, cfg.data.limit_train or enough)
    cfg.data.limit_val = 1
    trial = Job(cfg, job.choices, job.overrides, job.folder, job.name, False)
    try:
        run, clock = build(trial), _Clock()
        images = [_time(lambda: look_once(run.method, run.data)) for _ in range(_IMAGES)]
        run.trainer.callbacks.append(clock)  # type: ignore[attr-defined]
        run.trainer.fit(run.method, datamodule=run.data)
    finally:
        shutil.rmtree(job.folder, ignore_errors=True)
    steps = np.diff(clock.times)[_SKIPPED - 1 :]
    return Speed(float(steps.min()), float(np.median(images)))


def _time(work: Callable[[], None]) -> float:
    """Return how long a piece of work takes [s]."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began
