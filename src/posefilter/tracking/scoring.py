"""A method as tracking uses it: its own network and likelihood, with fewer image points a pose."""

import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.geometry.spaces import PoseSpace
from posefilter.models.base import PoseEstimator
from posefilter.nets.layers import fast_bfloat16
from posefilter.protocols import Encoding
from posefilter.types import Batch, ObjectModel, ParticleOutput, Particles, Step

_NEEDED = ("pose_space", "score_poses", "propose_poses", "objectness")


def check_method(method: PoseEstimator) -> None:
    """Raise UserError where a method cannot be tracked with."""
    missing = [name for name in _NEEDED if name not in method.capabilities]
    if missing:
        raise UserError(
            f"tracking: {type(method).__name__} provides no {missing[0]}; track with a checkpoint "
            f"of model=pose_pf model/proposals=dense"
        )


class FrameScorer:
    """Score poses in an encoded frame by few image points: a `Method` for the filter.

    Args:
        method: Scores and proposes poses.
        encoding: The frame, as the method has encoded it.
        points: Image points that a pose is scored from.
        jumps: Number of particles, the last ones at the first step, that no motion led to.
        against: Log odds against such a jump, taken off their scores at the first step [nat].
    """

    latent_width = 0

    def __init__(
        self,
        method: PoseEstimator,
        encoding: Encoding,
        points: int,
        jumps: int = 0,
        against: float = 0.0,
    ) -> None:
        self.method, self.points = method, points
        # few points tell more of a pose where they are spread evenly
        spread = getattr(encoding, "with_quasi_monte_carlo", None)
        self.encoding = encoding if spread is None else spread()
        self.jumps, self.against = jumps, against

    @property
    def space(self) -> PoseSpace:
        """SE(3) about the object's center."""
        space = self.method.space
        assert isinstance(space, PoseSpace)
        return space

    @property
    def object_model(self) -> ObjectModel:
        """The object."""
        return self.method.object_model

    def encode(self, batch: Batch) -> Encoding:
        """Return the frame, which is encoded already."""
        return self.encoding

    def measure(
        self, encoding: Encoding, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        """Score every particle at the step's noise level."""
        state = particles.state
        score = self.score_poses(encoding, state, float(step.sigma), generator, self.points)
        if step.number == 0 and self.jumps:
            score[:, -self.jumps :] -= self.against
        no_move = state.new_zeros(*state.shape[:2], self.space.dimensions)
        return ParticleOutput(score, no_move, state, particles.latent)

    def score_poses(
        self, encoding: Encoding, poses: Tensor, sigma: float, generator: Generator, pixels: int
    ) -> Tensor:
        """Score any poses at a noise level; see `ScoresPoses`."""
        device = self.method.device
        with torch.autocast(device.type, torch.bfloat16, enabled=fast_bfloat16(device)):
            score: Tensor = self.method.score_poses(encoding, poses, sigma, generator, pixels)  # type: ignore[operator]
        return score.float()

    def propose_poses(self, encoding: Encoding, particles: int, generator: Generator) -> Tensor:
        """Draw poses from the method's proposals; see `ProposesPoses`."""
        poses: Tensor = self.method.propose_poses(encoding, particles, generator)  # type: ignore[operator]
        return poses
