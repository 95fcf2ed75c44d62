"""Bounding boxes from particles: (left, top, right, bottom) [px], at the outer edges of pixels."""

from typing import ClassVar, Protocol

import torch
from torch import Tensor

from posefilter.capabilities import Capabilities
from posefilter.geometry.boxes import box_of_pose
from posefilter.types import Batch, ObjectModel, Trace


class BoxHead(Protocol):
    """Compute the object's bounding box."""

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return (B, 4) [px]; mask and pose of the batch must not be used."""


def weighted_quantile(values: Tensor, weights: Tensor, quantile: float) -> Tensor:
    """Return the weighted quantile of each column.

    Args:
        values: (B, N, D).
        weights: (B, N), summing to 1.
        quantile: Fraction of the weight that lies below the quantile.

    Returns:
        (B, D), each one of the values.
    """
    order = values.argsort(dim=1)
    mass = weights[..., None].expand_as(values).gather(1, order).cumsum(1)
    rank = (mass < quantile - 1e-6).sum(1, keepdim=True).clamp(max=values.shape[1] - 1)
    return values.gather(1, order).gather(1, rank)[:, 0]


class QuantileBox:
    """The box of the particles' positions, without their outermost weight.

    All that the paper's detector predicts is that its particles have moved onto the object.

    Args:
        size: Side of the patch [px]; the box is enlarged by half of it.
        quantile: Fraction of the weight that is left out at each side.
    """

    def __init__(self, size: int = 1, quantile: float = 0.05) -> None:
        self.size = size
        self.quantile = quantile

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return (B, 4) [px]."""
        state, weights = trace.particles[-1].state, trace.particles[-1].log_weights.exp()
        low = weighted_quantile(state, weights, self.quantile) - self.size / 2
        high = weighted_quantile(state, weights, 1 - self.quantile) + self.size / 2
        return torch.cat([low, high], dim=-1)


class VotedBox:
    """The weighted median of the sides that the particles predict, each in its latent."""

    requires: ClassVar[Capabilities] = ("free_latent",)
    latent_width = 4  # left, top, right, bottom

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return (B, 4) [px]."""
        particles, predicted = trace.particles[-1], trace.outputs[-1].latent * batch.rgb.shape[-1]
        sides = torch.cat(
            [particles.state - predicted[..., :2], particles.state + predicted[..., 2:]], dim=-1
        )
        return weighted_quantile(sides, particles.log_weights.exp(), 0.5)


class PoseBox:
    """The bounding box of the object's hull at the estimated pose."""

    requires: ClassVar[Capabilities] = ("pose",)

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return (B, 4) [px]."""
        height, width = batch.rgb.shape[-2:]
        return box_of_pose(trace.belief.best, object_model.hull, batch.intrinsics, height, width)
