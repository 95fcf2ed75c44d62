"""Regression of single points' scores, the paper's training of its likelihood (section 5)."""

from torch import Tensor

from posefilter.protocols import Label
from posefilter.types import Batch, ObjectModel, Trace


class Regression:
    """Weighted mean squared error between the predicted score of each sample and its label.

    The paper specifies neither the error nor a scale; with its labels of +-100 the errors are
    divided by `scale` first.

    Args:
        label: Gives the targets.
        scale: Divisor of the errors.
    """

    def __init__(self, label: Label, scale: float = 100.0) -> None:
        self.label, self.scale = label, scale

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return the error of each image, (B,)."""
        target = self.label(trace, batch, object_model)[-1]
        error = ((trace.outputs[-1].log_likelihood - target) / self.scale) ** 2
        return (error * trace.particles[-1].log_weights.exp()).sum(1)
