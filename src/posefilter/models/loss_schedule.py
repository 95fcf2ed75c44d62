"""Losses beside the chosen one, and how their weights change as training proceeds."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from posefilter.errors import UserError
from posefilter.protocols import Loss


class Auxiliary(NamedTuple):
    """A loss that is added to the chosen one."""

    loss: Loss
    weight: float = 1.0


class Stage(NamedTuple):
    """A part of training, and the factor on each loss by name (1 where it is not named) while it
    lasts.
    """

    until: float  # share of the training's steps at which it ends
    factors: Mapping[str, float] = MappingProxyType({})


def check_loss_schedule(loss_schedule: Sequence[Stage], names: Sequence[str]) -> None:
    """Raise UserError unless the stages follow one another up to 1 and name existing losses."""
    ends = [stage.until for stage in loss_schedule]
    if loss_schedule and (sorted(set(ends)) != ends or ends[-1] != 1):
        raise UserError(f"model.stages end at {ends}: the ends must rise, and the last be 1")
    for stage in loss_schedule:
        for name in stage.factors:
            if name not in names:
                raise UserError(
                    f"model.stages names the loss {name!r}: there are {', '.join(names)}"
                )


def factors_at(loss_schedule: Sequence[Stage], progress: float) -> Mapping[str, float]:
    """Return the factors in force at `progress` in [0, 1]; none without stages."""
    for stage in loss_schedule:
        if progress < stage.until:
            return stage.factors
    return loss_schedule[-1].factors if loss_schedule else {}
