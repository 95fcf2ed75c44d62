"""Is the particle on the object, and how good is what it stands for?"""

import torch
from torch import Tensor

from posefilter.geometry.lookup import touches
from posefilter.geometry.pose_error import deviation, thin
from posefilter.types import Batch, ObjectModel, Trace


class OnObject:
    """1 where the particle's size x size patch meets the object's mask, else 0 (the paper, eq. 4)."""

    def __init__(self, size: int = 1) -> None:
        self.size = size

    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return (T, B, N) in {0, 1}."""
        counts = [particles.state.shape[1] for particles in trace.particles]
        met = touches(
            batch.mask,
            torch.cat([particles.state for particles in trace.particles], dim=1),
            self.size,
        ).float()
        return torch.stack(met.split(counts, dim=1))


class Quality:
    """exp(-ADD / scale) on the object, 0 off it: a likelihood trained on it is the confidence in
    the particle's pose too.

    scale: in object diameters. The idea: a detection's score that is trained to be its quality (Li
    et al. 2020).
    """

    def __init__(self, size: int = 1, scale: float = 0.1, points: int = 64) -> None:
        self.on_object = OnObject(size)
        self.scale = scale
        self.points = points

    @torch.no_grad()
    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return (T, B, N) in [0, 1], without gradient."""
        points = thin(model.points, self.points).to(batch.rgb)
        off = torch.stack(
            [deviation(output.pose, batch.camera_from_object, points) for output in trace.outputs]
        )
        return self.on_object(trace, batch, model) * torch.exp(-off / (self.scale * model.diameter))
