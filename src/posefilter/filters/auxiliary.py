"""Auxiliary resampling by a predicted objectness map (the paper, section 6, idea 4)."""

from typing import ClassVar

import torch
from torch import Generator, Tensor

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.protocols import Encoding, HasObjectness, Resample, Space
from posefilter.types import Batch, Particles, Resampled


def gather_objectness(objectness: Tensor, state: Tensor, height: int, width: int) -> Tensor:
    """Return the objectness of the cell that each particle lies in; off the frame, of the nearest.

    A map (B, 1, h, w) over an image of height x width [px], particles (B, N, 2) [px] -> (B, N).
    """
    h, w = objectness.shape[-2:]
    fraction = (state.detach() + 0.5) / state.new_tensor([width, height])
    cell = (fraction * state.new_tensor([w, h])).floor().nan_to_num(0.0)
    column, row = cell[..., 0].clamp(0, w - 1).long(), cell[..., 1].clamp(0, h - 1).long()
    return objectness.flatten(1).gather(1, row * w + column)


def bind_to_encoding(resample: Resample, encoding: Encoding, batch: Batch) -> Resample:
    """Return the resampler bound to these images if it is auxiliary, else as it is."""
    if isinstance(resample, AuxiliaryResampling):
        return resample.bind(encoding, *batch.rgb.shape[-2:])
    return resample


class AuxiliaryResampling:
    """Draw ancestors by weight x objectness, and correct the weights by 1 / objectness.

    The first stage of an auxiliary particle filter (Pitt and Shephard 1999), with the objectness as
    its auxiliary function. The weighted distribution is unchanged: regions of the object get more
    children, each of less weight. This holds where weights are carried on
    (filter/reweight=likelihood_ratio, sequential_bayes). The choice current_likelihood discards
    them, so there it only concentrates the search.

    Args:
        resampler: The scheme that draws the ancestors.
        floor: Lower bound of the objectness, in (0, 1]; it bounds the correction.

    Raises:
        UserError: `floor` is out of range.
    """

    requires: ClassVar[Capabilities] = ("pixel_space", "objectness")

    def __init__(self, resampler: Resample, floor: float = 0.05) -> None:
        if not 0 < floor <= 1:
            raise UserError(f"filter.resample.floor={floor} must lie above 0, and at most at 1")
        self.resampler = resampler
        self.floor = floor

    def bind(self, encoding: HasObjectness, height: int, width: int) -> Resample:
        """Return the resampler for encoded images of height x width [px]."""
        objectness = encoding.objectness.detach()

        def resample(
            particles: Particles, count: int, space: Space, generator: Generator
        ) -> Resampled:
            values = gather_objectness(objectness, particles.state, height, width)
            log_auxiliary = values.clamp_min(self.floor).log()
            log_weights = torch.log_softmax(particles.log_weights + log_auxiliary, dim=1)
            weighted = particles._replace(log_weights=log_weights)
            resampled = self.resampler(weighted, count, space, generator)
            if resampled.mixture_weights is not None:
                raise UserError(
                    "filter/resample=auxiliary needs a resampler whose children have one ancestor "
                    "each; choose systematic"
                )
            log_weights = resampled.log_weights - log_auxiliary.gather(1, resampled.ancestors)
            return resampled._replace(log_weights=torch.log_softmax(log_weights, dim=1))

        return resample

    def __call__(
        self, particles: Particles, count: int, space: Space, generator: Generator
    ) -> Resampled:
        """Raise UserError: the objectness is known only after `bind`."""
        raise UserError("filter/resample=auxiliary must be bound to an encoding before it draws")
