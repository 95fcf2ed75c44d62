"""Learning-rate schedules over a run's steps."""

import math

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR


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

    def factor(step: int) -> float:
        if step < rise:
            return (step + 1) / rise
        done = min(1.0, (step - rise) / max(1, steps - rise))
        return min_lr_fraction + (1 - min_lr_fraction) * 0.5 * (1 + math.cos(math.pi * done))

    return LambdaLR(optimizer, factor)
