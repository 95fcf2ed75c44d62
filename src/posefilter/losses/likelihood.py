"""Losses of the particles' likelihood.

Here `log_likelihood` is the log-probability that the particle is on the object.
"""

from typing import ClassVar

import torch
from torch import Tensor

from posefilter.capabilities import Capabilities
from posefilter.errors import check_choice
from posefilter.protocols import Label
from posefilter.types import Batch, ObjectModel, Trace


def log1mexp(log_p: Tensor) -> Tensor:
    """Return log(1 - exp(log_p)) for log_p = logsigmoid(logit), accurate for logits up to 80.

    For larger logits, where log_p is subnormal, it stays finite, with zero gradient.
    """
    return torch.log(-torch.expm1(log_p.clamp(max=-1e-35)))


class Bce:
    """Binary cross-entropy with labels in [0, 1] (the paper, eq. 3, with its missing minus sign).

    Args:
        label: Gives the targets.
        steps: "last" for the last step only, or "all".
    """

    requires: ClassVar[Capabilities] = ("rollout",)

    def __init__(self, label: Label, steps: str = "all") -> None:
        self.label = label
        self.steps = steps

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return (B,)."""
        log_p, y, entropy = self._compare(trace, batch, object_model)
        return (self.weigh(log_p.detach(), y) * entropy).sum((0, 2))

    def _compare(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> tuple[Tensor, ...]:
        """Return log-likelihoods, labels and their cross-entropy, each (S, B, N)."""
        check_choice("loss.steps", self.steps, "last", "all")
        outputs = trace.outputs if self.steps == "all" else trace.outputs[-1:]
        log_p = torch.stack([output.log_likelihood for output in outputs])
        y = self.label(trace, batch, object_model)[-len(log_p) :]
        return log_p, y, -(y * log_p + (1 - y) * log1mexp(log_p))

    def weigh(self, log_p: Tensor, y: Tensor) -> Tensor:
        """Return each particle's weight; weights of an image sum to 1.  (S, B, N) x 2 -> (S, B,
        N).
        """
        return torch.full_like(y, 1 / (y.shape[0] * y.shape[2]))


class BalancedBce(Bce):
    """Binary cross-entropy in which positives and negatives of an image have half the weight
    each.
    """

    def weigh(self, log_p: Tensor, y: Tensor) -> Tensor:
        """Return weights that sum to 1/2 over y > 0 and over y = 0; to 1 if there is one class
        only.
        """
        positive = (y > 0).to(y.dtype)
        positives = positive.sum((0, 2), keepdim=True)
        negatives = (1 - positive).sum((0, 2), keepdim=True)
        classes = (positives > 0).to(y.dtype) + (negatives > 0).to(y.dtype)
        weights = positive / positives.clamp_min(1) + (1 - positive) / negatives.clamp_min(1)
        return weights / classes


class Focal(Bce):
    """Focal loss: cross-entropy x |y - p|^gamma, with class weights (Lin et al. 2017).

    With labels between 0 and 1 it is the quality focal loss (Li et al. 2020). Gradients flow
    through the modulating factor.

    Args:
        label: Gives the targets.
        steps: "last" for the last step only, or "all".
        gamma: Exponent of the modulating factor.
        alpha: Weight of positives; negatives have 1 - alpha.
    """

    def __init__(
        self, label: Label, steps: str = "all", gamma: float = 2.0, alpha: float = 0.25
    ) -> None:
        super().__init__(label, steps)
        self.gamma = gamma
        self.alpha = alpha

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return (B,)."""
        log_p, y, entropy = self._compare(trace, batch, object_model)
        side = torch.where(y > 0, self.alpha, 1 - self.alpha)
        focus = ((y - log_p.exp()).square() + 1e-12) ** (self.gamma / 2)
        return (side * focus * entropy).mean((0, 2))
