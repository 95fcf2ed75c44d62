"""The Brier score as a loss."""

from typing import ClassVar

from torch import Tensor

from posefilter.capabilities import Capabilities
from posefilter.protocols import Label
from posefilter.types import Batch, ObjectModel, Trace


class Brier:
    """Mean squared error of each particle's likelihood against a label in [0, 1], last step."""

    requires: ClassVar[Capabilities] = ("rollout",)

    def __init__(self, label: Label) -> None:
        self.label = label

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return one value an image, (B,)."""
        target = self.label(trace, batch, object_model)[-1]
        return (trace.outputs[-1].log_likelihood.exp() - target).square().mean(1)
