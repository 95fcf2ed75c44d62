"""A method whose particles are poses that compare the object's points with the measured depth."""

from typing import Any, ClassVar, NamedTuple

import torch
from torch import Generator, Tensor, nn

from posefilter.capabilities import Capabilities
from posefilter.geometry.camera import project
from posefilter.geometry.lookup import sample
from posefilter.geometry.pose import transform
from posefilter.geometry.pose_error import subsample
from posefilter.models.pose_particles import PoseParticles
from posefilter.types import Batch, ParticleOutput, Particles, Step


class Images(NamedTuple):
    """What `measure` is given as `encoding`."""

    image: Tensor  # (B, 4, H, W) color in [0, 1] and depth [m]
    intrinsics: Tensor  # (B, 3, 3) [px]


class DepthFit(PoseParticles):
    """A small network scores, at each of the object's points, what is seen where a pose puts it.

    Args:
        width: Of the network.
        points: Points of the object's surface.
        **base: Arguments of `PoseEstimator`.
    """

    provides: ClassVar[Capabilities] = ("pose", "pose_space", "rollout")

    def __init__(self, width: int = 32, points: int = 32, **base: Any) -> None:
        super().__init__(**base)
        self.net = nn.Sequential(nn.Linear(5, width), nn.ReLU(), nn.Linear(width, 1))
        self.points = points

    def encode(self, batch: Batch) -> Images:
        """Return the images as they are."""
        return Images(torch.cat([batch.rgb, batch.depth], dim=1), batch.intrinsics)

    def measure(
        self, encoding: Images, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        """Score each particle's pose, whose state it is: (B, N, 4, 4)."""
        poses = particles.state
        points = subsample(self.object_model.points, self.points).to(poses)
        placed = transform(poses, points)  # (B, N, P, 3) [m]
        pixels = project(placed.flatten(1, 2), encoding.intrinsics)
        seen = sample(encoding.image, pixels).unflatten(1, placed.shape[1:3])
        color, depth = seen[..., :3], seen[..., 3:]
        gap = ((depth - placed[..., 2:]) / self.object_model.radius).clamp(-2, 2)
        known = (depth > 0).to(gap)
        score = self.net(torch.cat([gap * known, known, color], dim=-1))[..., 0].mean(-1)
        still = score.new_zeros(*score.shape, self.space.dimensions)
        return ParticleOutput(score, still, poses, particles.latent)
