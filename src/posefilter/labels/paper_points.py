"""The paper's labels for points along the rays of the object's pixels (section 5)."""

import torch
from torch import Tensor

from posefilter.errors import UserError
from posefilter.types import Batch, ObjectModel, Trace


class PaperPoints:
    """+100 on the surface in its own color, 0 for possible occluders and foreign colors, -100
    behind the surface.

    Reads a cloud of samples (B, N, 4): pixel u, v, offset behind the observed surface [m], and 1
    where the sample kept the pixel's color, 0 where its color is random.
    """

    def __init__(self, tolerance: float = 0.01, on: float = 100.0, behind: float = -100.0) -> None:
        self.tolerance, self.on, self.behind = tolerance, on, behind

    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return labels (1, B, N)."""
        if trace.particles[-1].state.dim() != 3:
            raise UserError(
                "loss=regression judges points along rays, not poses: choose "
                "model/candidate_sampler=labeled_rays, or loss=contrast"
            )
        offset, own_color = (
            trace.particles[-1].state[..., 2],
            trace.particles[-1].state[..., 3] > 0.5,
        )
        label = torch.where(offset > self.tolerance, self.behind, 0.0)
        return torch.where((offset.abs() <= self.tolerance) & own_color, self.on, label)[None]
