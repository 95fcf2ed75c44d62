"""Resampling guided by a predicted map of where in the image to look (the paper, section 6, idea
4).
"""

import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.protocols import HasRelevance, Resample, Scene, Space
from posefilter.types import Batch, Particles, Resampled


def look_up(relevance: Tensor, state: Tensor, height: int, width: int) -> Tensor:
    """Return the relevance of the cell each particle stands in; of the nearest, off the frame.

    (B, 1, h, w), (B, N, 2) [px] in a frame of height x width -> (B, N).
    """
    h, w = relevance.shape[-2:]
    share = (state.detach() + 0.5) / state.new_tensor([width, height])
    cell = (share * state.new_tensor([w, h])).floor().nan_to_num(0.0)
    column, row = cell[..., 0].clamp(0, w - 1).long(), cell[..., 1].clamp(0, h - 1).long()
    return relevance.flatten(1).gather(1, row * w + column)


def bound(resample: Resample, scene: Scene, batch: Batch) -> Resample:
    """Return the resampler for these images, where it is of a kind that looks at them; else as it
    is.
    """
    return resample.bind(scene, *batch.rgb.shape[-2:]) if isinstance(resample, Guided) else resample


class Guided:
    """Draw parents by weight x relevance, and let children start with weights x 1 / relevance, so
    that the belief stays.

    The first stage of an auxiliary particle filter (Pitt and Shephard 1999): more children where it
    will pay, each counting for less, where weights are handed down (reweight=tempered, sequential).
    reweight=annealed forgets them: then this only searches where relevance is high. floor:
    relevance below it counts as it, since no child can make up for a parent never drawn.
    """

    def __init__(self, resampler: Resample, floor: float = 0.05) -> None:
        if not 0 < floor <= 1:
            raise UserError(f"resample.floor={floor} must lie above 0, and at most at 1")
        self.resampler = resampler
        self.floor = floor

    def bind(self, scene: Scene, height: int, width: int) -> Resample:
        """Return the resampler for these images."""
        if not isinstance(scene, HasRelevance):
            raise UserError(
                "resample=guided: the method makes no map of relevance; choose a context that "
                "does, such as unet"
            )
        relevance = scene.relevance.detach()

        def resample(
            particles: Particles, count: int, space: Space, generator: Generator
        ) -> Resampled:
            preference = (
                look_up(relevance, particles.state, height, width).clamp_min(self.floor).log()
            )
            return self.draw(particles, preference, count, space, generator)

        return resample

    def draw(
        self,
        particles: Particles,
        preference: Tensor,
        count: int,
        space: Space,
        generator: Generator,
    ) -> Resampled:
        """Return children drawn by weight x exp(preference).  preference (B, M)."""
        preferred = torch.log_softmax(particles.log_weights + preference, dim=1)
        resampled = self.resampler(
            particles._replace(log_weights=preferred), count, space, generator
        )
        if resampled.shares is not None:
            raise UserError(
                "resample=guided needs a resampler whose children have one parent "
                "each; choose systematic"
            )
        undone = resampled.log_weights - preference.gather(1, resampled.ancestors)
        return resampled._replace(log_weights=torch.log_softmax(undone, dim=1))

    def __call__(
        self, particles: Particles, count: int, space: Space, generator: Generator
    ) -> Resampled:
        """Refuse: without a scene there is no relevance."""
        raise UserError("resample=guided must be bound to a scene before it draws")
