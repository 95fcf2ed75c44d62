"""Begin a run with weights of finished ones, also of other objects: most of it is shared."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from posefilter.cli.checkpoints import read_checkpoint
from posefilter.errors import UserError
from posefilter.models.base import PoseEstimator
from posefilter.models.quantization import unpack
from posefilter.weights import expand_weights

_STATISTICS = ("running_mean", "running_var", "num_batches_tracked")  # of batch normalization


def read_starts(weights: Any, own: str) -> list[dict[str, Any]]:
    """Return the checkpoints that a training begins with.

    Args:
        weights: What `warm_start=` says: a checkpoint, `all` for those that ship, a pattern or a
            list of such (see `expand_weights`).
        own: Name of the object to be learned. Of several checkpoints, one that was trained on it
            is left out: a start from `all` is that of an object which is new.

    Raises:
        UserError: There is no such checkpoint, or it is unreadable.
    """
    found = [read_checkpoint(one, "warm_start") for one in expand_weights(weights, "warm_start")]
    others = [one for one in found if (one.get("object_model") or {}).get("name") != own]
    return found if len(found) == 1 or not others else others


def warm_start(
    method: PoseEstimator, checkpoints: Sequence[dict[str, Any]]
) -> tuple[int, list[str]]:
    """Copy the mean of checkpoints' weights into a method, wherever name and shape agree.

    Networks that were trained from a common ancestor lie in one basin of the loss, so that their
    mean is a network that keeps what they share (Wortsman et al. 2022, *Model soups*).

    Buffers that describe the object (such as the fragments of its surface) stay the method's own;
    the statistics of batch normalization are copied.

    Args:
        method: to be trained; it knows its own object already.
        checkpoints: of the same method, whole or as `export.py` writes them. A tensor that only
            some of them have is the mean of those.

    Returns:
        How many tensors were copied, and the names of the method's that were not found.

    Raises:
        UserError: if fewer than half of the method's tensors fit one of the checkpoints.
    """
    states = [unpack(one["state_dict"]) for one in checkpoints]
    wanted = {name: value.data for name, value in method.named_parameters()}
    wanted |= {
        name: value
        for name, value in method.named_buffers()
        if name.rsplit(".", 1)[-1] in _STATISTICS
    }
    for state in states:
        count = sum(_fits(state, name, value) for name, value in wanted.items())
        if count < len(wanted) / 2:
            raise UserError(
                f"warm_start: only {count} of {len(wanted)} tensors fit; "
                "the checkpoint comes from another model, or has other widths"
            )
    left = []
    with torch.no_grad():
        for name, value in wanted.items():
            found = [state[name].to(value) for state in states if _fits(state, name, value)]
            if found:
                value.copy_(found[0] if len(found) == 1 else torch.stack(found).double().mean(0))
            else:
                left.append(name)
    return len(wanted) - len(left), left


def name_modules(names: Iterable[str]) -> str:
    """Return the modules that parameters belong to, with how many each has: `likelihood.surface
    (6 tensors)`.
    """
    counts = Counter(".".join(name.split(".")[:-1][:2]) or name for name in names)
    return ", ".join(f"{module} ({count} tensors)" for module, count in counts.items())


def _fits(state: dict[str, Tensor], name: str, value: Tensor) -> bool:
    return name in state and state[name].shape == value.shape
