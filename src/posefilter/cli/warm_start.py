"""Begin a run with the weights of a finished one, of another object or other data: most of what is
learned is shared.
"""

from typing import Any

import torch

from posefilter.errors import UserError
from posefilter.models.base import PoseEstimator
from posefilter.models.quantization import unpack

_STATISTICS = ("running_mean", "running_var", "num_batches_tracked")  # of batch normalization


def warm_start(method: PoseEstimator, checkpoint: dict[str, Any]) -> tuple[int, int]:
    """Copy a checkpoint's weights into a method, wherever name and shape agree.

    Buffers that describe the object (such as the fragments of its surface) stay the method's own;
    the statistics of batch normalization are copied.

    Args:
        method: to be trained; it knows its own object already.
        checkpoint: of the same method, whole or as `export.py` writes it.

    Returns:
        How many tensors were copied, and how many of the method's were not found.

    Raises:
        UserError: if fewer than half of the method's tensors fit.
    """
    there = unpack(checkpoint["state_dict"])
    wanted = {name: value.data for name, value in method.named_parameters()}
    wanted |= {
        name: value
        for name, value in method.named_buffers()
        if name.rsplit(".", 1)[-1] in _STATISTICS
    }
    fitting = [
        name for name, value in wanted.items() if name in there and there[name].shape == value.shape
    ]
    if len(fitting) < len(wanted) / 2:
        raise UserError(
            f"warm_start: only {len(fitting)} of {len(wanted)} tensors fit; "
            "the checkpoint is of another model, or of other widths"
        )
    with torch.no_grad():
        for name in fitting:
            wanted[name].copy_(there[name])
    return len(fitting), len(wanted) - len(fitting)
