"""Learning-rate schedules over a run's steps."""

import math

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR


def warm_cosine(
    optimizer: Optimizer, steps: int, warm_up: int = 200, floor: float = 0.01
) -> LambdaLR:
    """Linear warm-up, then cosine decay.

    Args:
        optimizer: Its learning rates are the peak.
        steps: Length of the training.
        warm_up: Steps of the warm-up, at most a tenth of all.
        floor: Last learning rate, as a fraction of the peak.
    """
    rise = max(1, min(warm_up, steps // 10))

    def factor(step: int) -> float:
        if step < rise:
            return (step + 1) / rise
        done = min(1.0, (step - rise) / max(1, steps - rise))
        return floor + (1 - floor) * 0.5 * (1 + math.cos(math.pi * done))

    return LambdaLR(optimizer, factor)
