"""A comparison: particles of each part of a tool, and message passing between the parts.

After Pavlasek, Lewis, Desingh and Jenkins: Parts-based articulated object localization in clutter
using belief propagation. IROS (2020). The likelihood is that of `PosePF`, and so is the training.
"""

import math
from typing import Any, ClassVar

import torch
from torch import Generator, Tensor

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.filters.messages import pass_messages
from posefilter.geometry.fragments import sample_farthest_points
from posefilter.geometry.spaces import PartsSpace
from posefilter.models.pose_pf import PoseEncoding, PosePF
from posefilter.nets.likelihood import Region
from posefilter.types import ObjectModel, ParticleOutput, Particles, Step

_SURFACE_POINTS = 64  # of a part, as `SurfaceTerm` has them of the whole
_NEAR = 0.1  # share of a part's points that lie at its joint with another


class PartsPF(PosePF):
    """A particle filter over SE(3) with particles of each part, which pass messages.

    Particles come in one block for each part. Each is a pose of the whole object as its part sees
    it: the likelihood is asked at image points about that part alone. What the particles of the
    other parts say of it comes by messages (filters/messages.py).

    In training, and where poses are scored for a refinement, it is `PosePF`.

    Args:
        translation_mm: Standard deviation of the shift between two parts' poses, at their joint.
        rotation_deg: Standard deviation of the angle between two parts' poses.
            Both are widened by the step's noise level: by so much the particles are noisy.
        **base: Arguments of `PosePF`.

    Raises:
        UserError: A standard deviation is not positive.
    """

    provides: ClassVar[Capabilities] = (
        "color",
        "depth",
        "parts",
        "pose",
        "pose_space",
        "score_poses",
    )
    requires: ClassVar[Capabilities] = ("score_parts", "within_parts")
    test_only_settings = (*PosePF.test_only_settings, "translation_mm", "rotation_deg")

    def __init__(self, translation_mm: float = 5.0, rotation_deg: float = 5.0, **base: Any) -> None:
        super().__init__(**base)
        if min(translation_mm, rotation_deg) <= 0:
            raise UserError(
                f"model: translation_mm={translation_mm} and rotation_deg={rotation_deg} must be "
                "above 0"
            )
        self.translation_mm, self.rotation_deg = translation_mm, rotation_deg
        self._regions: list[Region] = []
        self._joints = torch.zeros(0, 0, 3)

    @property
    def space(self) -> PartsSpace:
        """SE(3) about the object's center, for each part."""
        own = self._space
        if not isinstance(own, PartsSpace):
            plain = super().space
            own = PartsSpace(plain.center, plain.radius, plain.points, len(self._regions))
            self._space = own
        return own

    def set_object(self, object_model: ObjectModel) -> None:
        """Set the object, and find its parts' centers, radii and joints.

        Raises:
            UserError: The object has no parts, or one alone.
        """
        parts = [*(object_model.parts or {}).values()]
        if len(parts) < 2:
            raise UserError(
                f"model=parts_pf: {object_model.name} has {len(parts)} parts, and messages go "
                "between two or more: declare them in parts.json beside its mesh, or choose "
                "model=pose_pf"
            )
        super().set_object(object_model)
        self._regions = [make_region(points) for points in parts]
        joints = [torch.stack([find_joint(a, b) for b in parts]) for a in parts]
        self._joints = torch.stack(joints)

    def measure(
        self, encoding: PoseEncoding, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        """Return the particles' log beliefs at the step's noise level as their log-likelihoods.

        The likelihood is asked once for each particle, as by `PosePF`.
        """
        if self.training:  # candidate poses, of no part
            return super().measure(encoding, particles, step, generator)
        poses, sigma = particles.state, step.sigma.reshape(-1, 1, 1)
        blocks = self.space.split(poses.shape[1])
        unary = torch.cat(
            [
                self._score(
                    encoding,
                    poses[:, block],
                    step.sigma,
                    generator,
                    self.pixels,
                    fast=True,
                    region=Region(part.center.to(poses), part.radius, part.surface.to(poses)),
                )
                for part, block in zip(self._regions, blocks, strict=True)
            ],
            dim=1,
        )
        shift, turn = self.space.noise_scale(sigma)[..., [0, 3]].unbind(-1)
        shift = (shift.square() + (self.translation_mm / 1000) ** 2).sqrt()
        turn = (turn.square() + math.radians(self.rotation_deg) ** 2).sqrt()
        belief = pass_messages(unary, poses, blocks, self._joints.to(poses), shift, turn)
        no_move = poses.new_zeros(*poses.shape[:2], self.space.dimensions)
        return ParticleOutput(belief, no_move, poses, particles.latent)


def make_region(points: Tensor) -> Region:
    """Return the ball about a part's bounding box, and points of its surface.

    (P, 3) [m], in the object's frame.
    """
    low, high = points.amin(0), points.amax(0)
    surface = sample_farthest_points(points, _SURFACE_POINTS)[0]
    return Region((low + high) / 2, float((high - low).norm()) / 2, surface)


def find_joint(a: Tensor, b: Tensor) -> Tensor:
    """Return the point where two parts meet: between the means of the tenth of each one's points
    that is nearest to the other.

    (P, 3), (Q, 3) [m], in the object's frame -> (3,).
    """
    distance = torch.cdist(a, b)
    ends = []
    for points, to_other in ((a, distance.amin(1)), (b, distance.amin(0))):
        near = to_other.topk(max(1, round(_NEAR * len(points))), largest=False).indices
        ends.append(points[near].mean(0))
    return (ends[0] + ends[1]) / 2
