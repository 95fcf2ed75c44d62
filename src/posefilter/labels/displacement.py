"""Which way should the particle go?"""

import torch
from torch import Tensor

from posefilter.errors import UserError
from posefilter.geometry.lookup import center_of, nearest_true, shrink
from posefilter.types import Batch, ObjectModel, Trace


class TowardsObject:
    """The displacement that would bring each particle onto the object.

    target: nearest (the mask's nearest pixel: zero for a particle that is on it) or center (the
    mask's centroid). margin_px: how far inside the mask's rim `nearest` aims, where the mask is
    wide enough. reach: the longest displacement asked for in one step, in frame widths; a farther
    target is approached along the straight line.
    """

    def __init__(
        self, target: str = "nearest", margin_px: int = 0, reach: float = float("inf")
    ) -> None:
        if target not in ("nearest", "center"):
            raise UserError(f"label.target={target!r} is unknown: choose nearest or center")
        self.target = target
        self.margin_px = margin_px
        self.reach = reach

    @torch.no_grad()
    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return (T, B, N, 2) [px], without gradient."""
        states = torch.stack([particles.state for particles in trace.particles])
        if self.target == "center":
            goal = center_of(batch.mask)[:, None].expand_as(states)
        else:
            flat = states.transpose(0, 1).flatten(1, 2)
            goal = nearest_true(shrink(batch.mask, self.margin_px), flat)
            goal = goal.unflatten(1, (len(states), -1)).transpose(0, 1)
        way = goal - states
        length = way.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        return way * (self.reach * batch.rgb.shape[-1] / length).clamp(max=1.0)
