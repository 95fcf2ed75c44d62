"""Pose errors by visibility: means over all images hide the effect of occlusion."""

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from posefilter.metrics.collect import PoseErrors, concat_state
from posefilter.types import ObjectModel

# lower end included, upper only at 1
RANGES = ((0.0, 0.3), (0.3, 0.5), (0.5, 0.8), (0.8, 1.0), (0.5, 1.0), (0.6, 1.0))


class ErrorsByVisibility(PoseErrors):
    """ADD and ADD-S of the instances in each range of visibility; unknown visibility is in none.

    Args:
        models: The objects.
        ranges: Lower (inclusive) and upper ends (exclusive, except 1).
        **kwargs: Arguments of torchmetrics.Metric.
    """

    visibility: list[Tensor]

    def __init__(
        self,
        models: Sequence[ObjectModel],
        ranges: Sequence[tuple[float, float]] = RANGES,
        **kwargs: Any,
    ) -> None:
        super().__init__(models, **kwargs)
        self.ranges = tuple(ranges)
        self.add_state("visibility", default=[], dist_reduce_fx="cat")

    def collect(self, poses: Tensor, truth: Tensor, visibility: Tensor) -> None:
        """Accumulate (B, 4, 4) estimates and truths with their visible shares (B,)."""
        self.update(poses, truth)
        self.visibility.append(visibility.double())

    def compute(self) -> dict[str, Any]:
        """Return {"0.3-0.5": {"instances", "add": {...}, "add_s": {...}}, ...} without empty
        ranges.
        """
        rows, visible = concat_state(self.rows).reshape(-1, 4), concat_state(self.visibility)
        out = {}
        for low, high in self.ranges:
            selected = (visible >= low) & ((visible < high) if high < 1 else (visible <= 1))
            if bool(selected.any()):
                parts = self.summarize(rows[selected])
                out[f"{low:g}-{high:g}"] = {"instances": int(selected.sum()), **parts}
        return out
