"""Learning-rate schedules over a run's steps."""

import inspect
import math
from collections.abc import Callable
from functools import partial
from typing import Any

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR, LRScheduler

from posefilter.errors import UserError

# parameters of a schedule that are given the number of steps of the training
LENGTHS = ("steps", "total_steps", "max_steps", "T_max")


def find_length(make: Callable[..., Any]) -> str | None:
    """Return the parameter of a schedule that is given the number of steps, where it is not set;
    None for one that needs no length.

    Args:
        make: Given the optimizer, and the number of steps by the name of the parameter.

    Raises:
        UserError: It needs another setting, which is missing.
    """
    parameters = [*inspect.signature(make).parameters.values()][1:]  # the first is the optimizer
    settings = getattr(make, "keywords", {})
    unset = [one for one in parameters if one.name not in settings]
    length = next((one.name for one in unset if one.name in LENGTHS), None)
    for one in unset:
        named = one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY)
        if named and one.default is one.empty and one.name != length:
            raise UserError(
                f"scheduler.{one.name}: is missing, and has no default; the number of steps is "
                f"given to a parameter {', '.join(LENGTHS[:-1])} or {LENGTHS[-1]}"
            )
    return length


def start_schedule(make: Callable[..., LRScheduler], optimizer: Optimizer, trainer: Any) -> Any:
    """Return the schedule of a training, over the trainer's number of steps where it needs one.

    Raises:
        UserError: It needs one, and the training has no end.
    """
    length = find_length(make)
    if length is None:
        return make(optimizer)
    steps = trainer.estimated_stepping_batches
    if not math.isfinite(steps):
        raise UserError(
            "trainer.max_steps=-1: the learning rate's schedule goes by the number of steps; "
            "give it, or choose scheduler=none"
        )
    return make(optimizer, **{length: int(steps)})


def check_length(make: Callable[..., Any], schedule: Any, trainer: Any) -> None:
    """Check that a schedule goes on to the end of a training: a checkpoint brings its length, too.

    Beyond it torch's `OneCycleLR` ends in an error, and `CosineAnnealingLR` rises again.

    Args:
        make: What the schedule was made by.
        schedule: It, with the state that the training goes on from.
        trainer: Of the training.

    Raises:
        UserError: The training goes on for more steps.
    """
    length = find_length(make)
    kept = getattr(schedule, length, None) if length is not None else None
    steps = trainer.estimated_stepping_batches
    if isinstance(kept, int) and kept < steps:
        raise UserError(
            f"trainer.max_steps={trainer.max_steps}: the training goes on for {steps} steps, and "
            f"its schedule of the learning rate, {type(schedule).__name__}, ends after {kept}, "
            "with which it began; leave it at that, or begin a new run, warm_start=CHECKPOINT"
        )


def warmup_cosine(
    optimizer: Optimizer, steps: int, warmup_steps: int = 200, min_lr_fraction: float = 0.01
) -> LambdaLR:
    """Linear warm-up, then cosine decay.

    Args:
        optimizer: Its learning rates are the peak.
        steps: Length of the training.
        warmup_steps: Steps of the warm-up, at most a tenth of all.
        min_lr_fraction: Last learning rate, as a fraction of the peak.
    """
    rise = max(1, min(warmup_steps, steps // 10))
    return LambdaLR(optimizer, partial(_find_factor, steps, rise, min_lr_fraction))


def _find_factor(steps: int, rise: int, least: float, step: int) -> float:
    """Return the learning rate at a step, as a fraction of the peak.

    At the top of the module, so that a trainer can be pickled.
    """
    if step < rise:
        return (step + 1) / rise
    done = min(1.0, (step - rise) / max(1, steps - rise))
    return least + (1 - least) * 0.5 * (1 + math.cos(math.pi * done))
