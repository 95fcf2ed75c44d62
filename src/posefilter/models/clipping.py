"""Gradient clipping by submodule."""

import math

from torch import nn


def clip_submodules(module: nn.Module, limit: float | None) -> list[str]:
    """Clip the gradient of each direct submodule by its own norm.

    A submodule whose gradient is not finite loses it, so that no optimizer updates its parameters.

    Args:
        module: Its submodules have gradients.
        limit: Largest norm; None or 0: none.

    Returns:
        The names of the submodules whose gradient was not finite.
    """
    skipped = []
    for name, part in module.named_children():
        parameters = [p for p in part.parameters() if p.grad is not None]
        if not parameters:
            continue
        if not bool(nn.utils.clip_grad_norm_(parameters, limit or math.inf).isfinite()):
            skipped.append(name)
            for parameter in parameters:
                parameter.grad = None  # zeros would still move it, by momentum
    return skipped
