"""Regression of single points' scores to labels, as the paper trains its likelihood (section 5)."""

from torch import Tensor

from posefilter.protocols import Label
from posefilter.types import Batch, ObjectModel, Trace


class Regression:
    """Weighted mean squared error between what the network says of each sample and its label, over
    `scale`.

    The paper states neither the error (ours: squares) nor a scale; its labels of +-100 make plain
    squares of 10^4.
    """

    def __init__(self, label: Label, scale: float = 100.0) -> None:
        self.label, self.scale = label, scale

    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return the error an image, (B,)."""
        target = self.label(trace, batch, model)[-1]
        error = ((trace.outputs[-1].log_likelihood - target) / self.scale) ** 2
        return (error * trace.particles[-1].log_weights.exp()).sum(1)
