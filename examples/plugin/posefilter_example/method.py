"""A method whose particles are pixels that look at one color and walk."""

from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Generator, Tensor, nn

from posefilter.capabilities import Capabilities
from posefilter.geometry.lookup import sample
from posefilter.geometry.spaces import PixelSpace
from posefilter.models.base import PoseEstimator
from posefilter.models.box_heads import QuantileBox
from posefilter.types import Batch, ParticleOutput, Particles, Step, Trace


class ColorWalk(PoseEstimator):
    """A small network turns the color and depth under a particle into a likelihood and a
    displacement.
    """

    provides: ClassVar[Capabilities] = ("displacement", "pixel_space", "rollout")

    def __init__(self, width: int = 32, reach_px: float = 20.0, **base: Any) -> None:
        super().__init__(**base)
        self.net = nn.Sequential(nn.Linear(4, width), nn.ReLU(), nn.Linear(width, 3))
        self.reach_px = reach_px

    @property
    def space(self) -> PixelSpace:
        """Return the image plane."""
        return PixelSpace()

    def encode(self, batch: Batch) -> Tensor:
        """Return color and depth, (B, 4, H, W)."""
        return torch.cat([batch.rgb, batch.depth], dim=1)

    def measure(
        self, encoding: Tensor, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        """Look at each particle's pixel."""
        out = self.net(sample(encoding, particles.state))
        pose = torch.eye(4, device=out.device).expand(*out.shape[:2], 4, 4)
        displacement = self.reach_px * torch.tanh(out[..., 1:])
        return ParticleOutput(F.logsigmoid(out[..., 0]), displacement, pose, particles.latent)

    def box(self, trace: Trace, batch: Batch) -> Tensor:
        """Return where the particles are, (B, 4) [px]."""
        return QuantileBox(size=9)(trace, batch, self.object_model)
