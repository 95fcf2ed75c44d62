"""Gradient clipping by submodule."""

import logging
import math

from torch import nn

log = logging.getLogger(__name__)
PATIENCE = 20  # steps in a row whose gradient is not finite, after which a training ends


class SubmoduleClipper:
    """Clips the gradient of each submodule by its own norm, so that a large gradient of one network
    does not shrink another's.

    A submodule whose gradient is not finite is not updated by this step, with a warning; also where
    nothing is clipped.
    """

    def __init__(self) -> None:
        self.skipped_steps = self.skipped_in_a_row = 0

    def clip(self, module: nn.Module, limit: float | None, step: int) -> None:
        """Clip the gradients of a step; arguments as of `clip_submodules`.

        Raises:
            FloatingPointError: 20 steps in a row had a gradient that is not finite in any
                submodule.
        """
        skipped = clip_submodules(module, limit)
        self.skipped_steps += bool(skipped)
        self.skipped_in_a_row = self.skipped_in_a_row + 1 if skipped else 0
        if skipped and self.skipped_steps in (1, 10, 100, 1000, 10_000):
            log.warning(
                "step %d does not update %s, whose gradient is not finite (%d such steps so far)",
                step,
                ", ".join(skipped),
                self.skipped_steps,
            )
        if self.skipped_in_a_row == PATIENCE:
            raise FloatingPointError(
                f"the gradient of {', '.join(skipped)} was not finite in {PATIENCE} steps in a "
                "row: in a roll-out it can grow with each step; choose model.detach_position=true "
                "or model/train_rollout=short (image space), or fewer filter.steps"
            )


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
