"""Pose errors by visibility: means over all images hide the effect of occlusion."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from posefilter.metrics.collect import Rows, concat_state, summarize_errors
from posefilter.types import ObjectModel

# lower end included, upper only at 1
RANGES = ((0.0, 0.3), (0.3, 0.5), (0.5, 0.8), (0.8, 1.0), (0.5, 1.0), (0.6, 1.0))


class ErrorsByVisibility(Rows):
    """ADD and ADD-S of the instances in each range of visibility; unknown visibility is in none.

    Args:
        models: The objects.
        ranges: Lower (inclusive) and upper ends (exclusive, except 1).
        **kwargs: Arguments of torchmetrics.Metric.
    """

    def __init__(
        self,
        models: Sequence[ObjectModel],
        ranges: Sequence[tuple[float, float]] = RANGES,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        self.models, self.ranges = list(models), tuple(ranges)

    def update(self, errors: Tensor, visibility: Tensor) -> None:
        """Accumulate the rows of PoseErrors, (B, 4), with the instances' visible shares (B,)."""
        self.rows.append(torch.cat([errors, visibility.to(errors)[:, None]], dim=1))

    def compute(self) -> dict[str, Any]:
        """Return {"0.3-0.5": {"instances", "add": {...}, "add_s": {...}}, ...} without empty
        ranges.
        """
        rows = concat_state(self.rows).reshape(-1, 5)
        visible = rows[:, 4]
        out = {}
        for low, high in self.ranges:
            selected = (visible >= low) & ((visible < high) if high < 1 else (visible <= 1))
            if bool(selected.any()):
                blocks = summarize_errors(rows[selected, :4], self.models)
                out[f"{low:g}-{high:g}"] = {"instances": int(selected.sum()), **blocks}
        return out
