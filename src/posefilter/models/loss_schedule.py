"""Auxiliary losses, and weights of all losses that change as training proceeds."""

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
    """A part of training with its own weights of the losses."""

    until: float  # fraction of the training's steps at which it ends
    loss_weights: Mapping[str, float] = MappingProxyType({})  # by name; others have 1


def check_loss_schedule(loss_schedule: Sequence[Stage], names: Sequence[str]) -> None:
    """Raise UserError where the ends of the stages do not rise to 1, or name a loss that is not
    among `names`.
    """
    ends = [stage.until for stage in loss_schedule]
    if loss_schedule and (sorted(set(ends)) != ends or ends[-1] != 1):
        raise UserError(f"model.loss_schedule ends at {ends}: the ends must rise, the last be 1")
    for stage in loss_schedule:
        for name in stage.loss_weights:
            if name not in names:
                raise UserError(
                    f"model.loss_schedule names the loss {name!r}: there are {', '.join(names)}"
                )


def loss_weights_at(loss_schedule: Sequence[Stage], progress: float) -> Mapping[str, float]:
    """Return the weights at a fraction `progress` of the training, in [0, 1]; none without
    stages.
    """
    for stage in loss_schedule:
        if progress < stage.until:
            return stage.loss_weights
    return loss_schedule[-1].loss_weights if loss_schedule else {}
