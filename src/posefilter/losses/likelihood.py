"""Losses on the particle's likelihood.

`log_likelihood` is the log probability that the particle is on the object.
"""

import torch
from torch import Tensor

from posefilter.errors import UserError
from posefilter.protocols import Label
from posefilter.types import Batch, ObjectModel, Trace


def log_not(log_p: Tensor) -> Tensor:
    """Return log(1 - p) from log p = logsigmoid(logit), exact at both ends, its slope in the logit
    too, up to a logit of 80.

    Beyond, where even log p is all but denormal, it stays finite and has no slope.
    """
    return torch.log(-torch.expm1(log_p.clamp(max=-1e-35)))


def said(trace: Trace, steps: str) -> Tensor:
    """Return the likelihoods of the last reading, or of all: (S, B, N)."""
    if steps not in ("last", "all"):
        raise UserError(f"loss.steps={steps!r} is unknown: choose last or all")
    outputs = trace.outputs if steps == "all" else trace.outputs[-1:]
    return torch.stack([output.log_likelihood for output in outputs])


class Bce:
    """Binary cross-entropy against a label in [0, 1] (the paper, eq. 3, whose minus sign is
    restored).

    steps: last (the prediction that the filter ends with) or all.
    """

    def __init__(self, label: Label, steps: str = "all") -> None:
        self.label = label
        self.steps = steps

    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return (B,)."""
        log_p = said(trace, self.steps)
        y = self.label(trace, batch, model)[-len(log_p) :]
        return (self.weigh(log_p.detach(), y) * -(y * log_p + (1 - y) * log_not(log_p))).sum((0, 2))

    def weigh(self, log_p: Tensor, y: Tensor) -> Tensor:
        """Return each particle's weight, summing to 1 an image.  (S, B, N) x 2 -> (S, B, N)."""
        return torch.full_like(y, 1 / (y.shape[0] * y.shape[2]))


class BalancedBce(Bce):
    """The same, with particles on the object and off it counting half each, however few either are."""

    def weigh(self, log_p: Tensor, y: Tensor) -> Tensor:
        """Return weights that sum to 1/2 over y > 0 and to 1/2 over y = 0 (or to 1 over the only
        kind there is).
        """
        on = (y > 0).to(y.dtype)
        share = on.sum((0, 2), keepdim=True)
        rest = (1 - on).sum((0, 2), keepdim=True)
        kinds = (share > 0).to(y.dtype) + (rest > 0).to(y.dtype)
        return (on / share.clamp_min(1) + (1 - on) / rest.clamp_min(1)) / kinds


class Focal(Bce):
    """Focal loss: cross-entropy x |y - p|^gamma, and alpha on the object against 1 - alpha off it
    (Lin et al. 2017).

    With labels between 0 and 1 it is the quality focal loss (Li et al. 2020). The modulation takes
    part in the gradient.
    """

    def __init__(
        self, label: Label, steps: str = "all", gamma: float = 2.0, alpha: float = 0.25
    ) -> None:
        super().__init__(label, steps)
        self.gamma = gamma
        self.alpha = alpha

    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return (B,)."""
        log_p = said(trace, self.steps)
        y = self.label(trace, batch, model)[-len(log_p) :]
        entropy = -(y * log_p + (1 - y) * log_not(log_p))
        side = torch.where(y > 0, self.alpha, 1 - self.alpha)
        return (side * ((y - log_p.exp()).square() + 1e-12) ** (self.gamma / 2) * entropy).mean(
            (0, 2)
        )
