"""How large an object appears over a dataset: whether the depth and the intrinsics are right."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from torch import Tensor

from posefilter.metrics.collect import Rows

_FEWEST = 3  # images that tell a dataset's scale


class ScaleRatioColumns(NamedTuple):
    """The scale ratios of N images: (N,) each."""

    scale: Tensor  # relative to the mesh
    contradicts: Tensor  # bool; the inputs cannot be right


class ScaleRatios(Rows[ScaleRatioColumns]):
    """The scale ratios of images that show the object; 1 where the inputs are right.

    images: in how many it could be told. ratio: the median of these. contradicting: in how many of
    them the inputs cannot be right.
    """

    columns = ScaleRatioColumns

    def update(self, scale: Tensor, contradicts: Tensor) -> None:
        """Accumulate images; (B,) with NaN where nothing can be told, and (B,) bool."""
        measured = ~scale.isnan()
        self.append(ScaleRatioColumns(scale[measured].cpu(), contradicts[measured].cpu()))

    def compute(self) -> dict[str, Any] | None:
        """Return the numbers; None where no image tells."""
        scale, contradicts = self.all()
        if not len(scale):
            return None
        return {
            "images": len(scale),
            "ratio": float(scale.quantile(0.5)),
            "contradicting": int(contradicts.sum()),
        }


def describe_mismatch(size: Mapping[str, Any], root: str) -> str:
    """Return in words that most images show the object in a size that cannot be; "" if not so.

    Args:
        size: What `ScaleRatios` computed, or nothing.
        root: The dataset's folder.
    """
    if not size or size["images"] < _FEWEST or 2 * size["contradicting"] <= size["images"]:
        return ""
    return (
        f"the object appears {size['ratio']:.2f} times its size (median of {size['images']} "
        f"images): the depth, the intrinsics or the mesh's unit are not those of data.root={root}"
    )
