"""Labels of membership: is the particle on the object, and how accurate is its pose?"""

from typing import ClassVar

import torch
from torch import Tensor

from posefilter.capabilities import Capabilities
from posefilter.geometry.lookup import overlaps_mask
from posefilter.geometry.pose_error import add_distance, subsample
from posefilter.types import Batch, ObjectModel, Trace


class OnObject:
    """1 where the particle's patch overlaps the object's mask, else 0 (the paper, eq. 4).

    Args:
        size: Side of the patch [px].
    """

    requires: ClassVar[Capabilities] = ("pixel_space",)

    def __init__(self, size: int = 1) -> None:
        self.size = size

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return (T, B, N) in {0, 1}."""
        counts = [particles.state.shape[1] for particles in trace.particles]
        states = torch.cat([particles.state for particles in trace.particles], dim=1)
        labels = overlaps_mask(batch.mask, states, self.size).float()
        return torch.stack(labels.split(counts, dim=1))


class Quality:
    """exp(-ADD / scale) on the object, 0 off it: the likelihood becomes a confidence in the pose.

    As in the quality focal loss, where a detection's score is its localization quality (Li et al.
    2020).

    Args:
        size: Side of the patch that must overlap the mask [px].
        scale: ADD at which the label is 1 / e, in diameters.
        points: Number of points of ADD.
    """

    requires: ClassVar[Capabilities] = ("pixel_space", "pose")

    def __init__(self, size: int = 1, scale: float = 0.1, points: int = 64) -> None:
        self.on_object = OnObject(size)
        self.scale = scale
        self.points = points

    @torch.no_grad()
    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return (T, B, N) in [0, 1], without gradient."""
        points = subsample(object_model.points, self.points).to(batch.rgb)
        truth, scale = batch.camera_from_object, self.scale * object_model.diameter
        error = torch.stack([add_distance(out.pose, truth, points) for out in trace.outputs])
        return self.on_object(trace, batch, object_model) * torch.exp(-error / scale)
