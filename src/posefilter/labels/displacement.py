"""Target displacements."""

from typing import ClassVar

import torch
from torch import Tensor

from posefilter.capabilities import Capabilities
from posefilter.errors import check_choice
from posefilter.geometry.lookup import centroid, erode, nearest_mask_pixel
from posefilter.types import Batch, ObjectModel, Trace


class TowardsObject:
    """The displacement from each particle to the object.

    Args:
        target: "nearest" for the nearest mask pixel (zero on the mask), or "center" for the mask's
            centroid.  Without a mask both are zero.
        margin_px: Erosion of the mask for `nearest` [px], where the mask is wide enough.
        max_displacement: Maximum length, in frame widths; longer ones keep their direction.

    Raises:
        UserError: `target` is unknown.
    """

    requires: ClassVar[Capabilities] = ("pixel_space",)

    def __init__(
        self, target: str = "nearest", margin_px: int = 0, max_displacement: float = float("inf")
    ) -> None:
        check_choice("label.target", target, "nearest", "center")
        self.target = target
        self.margin_px = margin_px
        self.max_displacement = max_displacement

    @torch.no_grad()
    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return (T, B, N, 2) [px], without gradient."""
        states = torch.stack([particles.state for particles in trace.particles])
        if self.target == "center":
            shown = batch.mask.flatten(1).any(1)[:, None, None]
            goal = torch.where(shown, centroid(batch.mask)[:, None], states)
        else:
            flat = states.transpose(0, 1).flatten(1, 2)
            goal = nearest_mask_pixel(erode(batch.mask, self.margin_px), flat)
            goal = goal.unflatten(1, (len(states), -1)).transpose(0, 1)
        way = goal - states
        length = way.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        return way * (self.max_displacement * batch.rgb.shape[-1] / length).clamp(max=1.0)
