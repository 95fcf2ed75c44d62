"""How long a step of a training and an image of its test take, measured before it begins."""

import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from lightning.pytorch.callbacks import LambdaCallback

from posefilter.cli.job import Job
from posefilter.cli.train import build, look_once

_STEPS, _SKIPPED = 9, 3  # the first steps fill caches
_IMAGES = 3


class Speed(NamedTuple):
    """Of a training on this machine."""

    step: float  # the fastest of some, as what else runs here may end [s]
    image: float  # of the filter, likewise [s]


def measure_speed(job: Job) -> Speed:
    """Measure a training by some steps; these, and all that it wrote, are thrown away."""
    cfg = job.cfg.copy()
    cfg.trainer.max_steps = cfg.trainer.val_check_interval = _STEPS
    cfg.trainer.limit_val_batches = 0
    cfg.callbacks, cfg.logger = {}, {}
    enough = (_STEPS + 1) * cfg.data.batch_size  # frames that are decoded for it
    cfg.data.limit_train = min(enough, cfg.data.limit_train or enough)
    cfg.data.limit_val = 1
    # as if nothing were typed: there may be more renders than it needs
    trial = replace(job, cfg=cfg, overrides=[], swept=False)
    times = list[float]()
    clock = LambdaCallback(on_train_batch_end=lambda *_: times.append(time.perf_counter()))
    try:
        run = build(trial)
        run.method.to(run.trainer.strategy.root_device)  # as the fit does, which comes later
        images = [_time(lambda: look_once(run.method, run.data)) for _ in range(_IMAGES)]
        run.trainer.callbacks.append(clock)  # type: ignore[attr-defined]
        run.trainer.fit(run.method, datamodule=run.data)
    finally:
        shutil.rmtree(job.folder, ignore_errors=True)
    steps = np.diff(times)[_SKIPPED - 1 :]
    return Speed(float(steps.min()), min(images))


def _time(work: Callable[[], None]) -> float:
    """Return how long a piece of work takes [s]."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began
