"""How a cloud of pixels bounds the object in the image: (left, top, right, bottom), the outer edges
of pixels.
"""

from typing import ClassVar, Protocol

import torch
from torch import Tensor

from posefilter.capabilities import Capabilities
from posefilter.geometry.boxes import box_of_pose
from posefilter.types import Batch, ObjectModel, Trace


class BoxHead(Protocol):
    """Bounds the object."""

    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return (B, 4) [px]; reads neither mask nor pose of the batch."""
        ...


def weighted_quantile(values: Tensor, weights: Tensor, share: float) -> Tensor:
    """Return the value below which `share` of the weight lies.

    (B, N, D), (B, N) summing to 1 -> (B, D).
    """
    order = values.argsort(dim=1)
    mass = weights[..., None].expand_as(values).gather(1, order).cumsum(1)
    place = (mass < share - 1e-6).sum(1, keepdim=True).clamp(max=values.shape[1] - 1)
    return values.gather(1, order).gather(1, place)[:, 0]


class SpreadBox:
    """Where the particles are: all but a share `beyond` of their weight on each side, and their
    patches' reach.

    All that the paper's detector can say: its particles should have moved onto the object.
    """

    def __init__(self, size: int = 1, beyond: float = 0.05) -> None:
        self.size = size
        self.beyond = beyond

    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return (B, 4) [px]."""
        state, weights = trace.particles[-1].state, trace.particles[-1].log_weights.exp()
        low = weighted_quantile(state, weights, self.beyond) - self.size / 2
        high = weighted_quantile(state, weights, 1 - self.beyond) + self.size / 2
        return torch.cat([low, high], dim=-1)


class VotedBox:
    """What the particles say: the weighted median of where each puts the box's sides (its latent;
    see losses.Sides).
    """

    requires: ClassVar[Capabilities] = ("free_latent",)
    latent_width = 4  # numbers that it reads

    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return (B, 4) [px]."""
        particles, predicted = trace.particles[-1], trace.outputs[-1].latent * batch.rgb.shape[-1]
        sides = torch.cat(
            [particles.state - predicted[..., :2], particles.state + predicted[..., 2:]], dim=-1
        )
        return weighted_quantile(sides, particles.log_weights.exp(), 0.5)


class PoseBox:
    """Where the estimated pose puts the object's hull."""

    requires: ClassVar[Capabilities] = ("pose",)

    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return (B, 4) [px]."""
        height, width = batch.rgb.shape[-2:]
        return box_of_pose(trace.belief.best, model.hull, batch.intrinsics, height, width)
