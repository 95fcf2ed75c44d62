"""The same errors, told apart by how much of the object can be seen: an average over images hides
what occlusion does.
"""

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from posefilter.metrics.collect import PoseErrors, joined
from posefilter.metrics.scores import summary
from posefilter.types import ObjectModel

# lower end included, upper only at 1
RANGES = ((0.0, 0.3), (0.3, 0.5), (0.5, 0.8), (0.8, 1.0), (0.5, 1.0), (0.6, 1.0))


class ErrorsByVisibility(PoseErrors):
    """ADD and ADD-S of the instances whose visible share lies in each range; unknown shares are in
    none.
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
        """Collect (B, 4, 4) estimates and truths with the visible shares (B,)."""
        self.update(poses, truth)
        self.visibility.append(visibility.double())

    def compute(self) -> dict[str, Any]:
        """Return {"0.3-0.5": {"instances", "add": {...}, "add_s": {...}}, ...}, empty ranges left
        out.
        """
        add, add_s, diameter, seen = (
            joined(x) for x in (self.add, self.add_s, self.diameter, self.visibility)
        )
        out = {}
        for low, high in self.ranges:
            here = (seen >= low) & ((seen < high) if high < 1 else (seen <= 1))
            if bool(here.any()):
                parts = {
                    "add": summary(add[here], diameter[here]),
                    "add_s": summary(add_s[here], diameter[here]),
                }
                out[f"{low:g}-{high:g}"] = {"instances": int(here.sum()), **parts}
        return out
