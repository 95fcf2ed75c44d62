"""Which of several objects keeps a pixel."""

from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor


def keep_pixels(masks: Sequence[Tensor], min_fraction: float) -> list[Tensor | None]:
    """Let each of several objects keep the pixels that none before it has taken.

    Args:
        masks: (H, W) bool each, the most probable object first.
        min_fraction: Share of its pixels that an object must keep, or it keeps none.

    Returns:
        The pixels that each keeps, no two the same; None for an object that is on the pixels of
        those before it, or on none.
    """
    taken: Tensor | None = None
    out: list[Tensor | None] = []
    for mask in masks:
        own = mask if taken is None else mask & ~taken
        total = int(mask.sum())
        if total == 0 or int(own.sum()) < min_fraction * total:
            out.append(None)
            continue
        taken = own if taken is None else taken | own
        out.append(own)
    return out


def resize_mask(mask: Tensor, size: tuple[int, int]) -> Tensor:
    """Return a mask (H, W) bool at another size, by the nearest pixel."""
    if (mask.shape[0], mask.shape[1]) == size:
        return mask
    # "nearest" alone takes the pixel before, so that masks shift
    return F.interpolate(mask[None, None].float(), size, mode="nearest-exact")[0, 0] > 0
