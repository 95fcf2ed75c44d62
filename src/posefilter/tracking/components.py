"""The parts of a track's filter: where its particles start, the estimate and its smoothing over
time, and turns by texture.
"""

import torch
from torch import Generator, Tensor

from posefilter.filters.texture import TextureRotations
from posefilter.geometry.pose import take_poses
from posefilter.geometry.pose_statistics import twist_between
from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Encoding, Method
from posefilter.types import Batch, BeliefBatch, ParticleOutput, Particles


class FromBelief:
    """Start from given poses, and a few that the method proposes: an `Initialize`.

    With the proposals the filter is never blind to the rest of what the network sees.

    Args:
        poses: (1, N, 4, 4) draws of the predictive distribution [m].
        proposals: Number of poses that the method proposes.
    """

    def __init__(self, poses: Tensor, proposals: int) -> None:
        self.poses, self.proposals = poses, proposals

    def __call__(
        self, batch: Batch, encoding: Encoding, method: Method, particles: int, generator: Generator
    ) -> Tensor:
        """Return (1, N + proposals, 4, 4) [m]."""
        if not self.proposals:
            return self.poses
        proposed = method.propose_poses(encoding, self.proposals, generator)  # type: ignore[attr-defined]
        return torch.cat([self.poses, proposed], dim=1)


class ModeMean:
    """The weighted mean of the particles near the one of highest likelihood: an `Estimate`.

    It varies less from frame to frame than the best particle does, and unlike the mean over all
    particles it does not lie between modes. The score is the weighted mean of their
    log-likelihoods.

    Args:
        max_distance: Distance within which particles belong to the mode [m].
    """

    def __init__(self, max_distance: float) -> None:
        self.max_distance = max_distance

    def __call__(
        self,
        particles: Particles,
        output: ParticleOutput,
        encoding: Encoding,
        method: Method,
        generator: Generator,
    ) -> BeliefBatch:
        """Return the belief."""
        space, poses = method.space, output.pose
        assert isinstance(space, PoseSpace)
        top = take_poses(poses, particles.log_weights.argmax(1, keepdim=True))
        near = space.distance(poses, top) < self.max_distance
        weights = torch.where(near, particles.log_weights, -torch.inf).softmax(1)
        score = (weights * output.log_likelihood).sum(1)
        return BeliefBatch(poses, particles.log_weights, space.mean(poses, weights), score)


def smooth(predicted: Tensor, measured: Tensor, space: PoseSpace, noise: float) -> Tensor:
    """Return a pose between what was predicted and what was measured.  (B, 4, 4) x 2 -> (B, 4, 4).

    The share of the measured is d^2 / (d^2 + noise^2), where d is the distance of the two, and
    noise the standard deviation of the estimate of a single frame [m]: what measurement noise
    explains is damped, and a motion is followed.
    """
    square = space.distance(predicted, measured).square()[:, None]
    share = square / (square + noise**2).clamp_min(1e-20)
    twist = twist_between(predicted, measured, predicted.new_tensor(space.center))
    return space.move(predicted, share * twist)


class RotateTogether:
    """Turn the estimate by the texture, and all particles by the same turn.

    In a single image particles spread over the turns that its texture leaves open. In a track the
    frames before have decided among them, and particles that each frame scattered anew would be
    missing where the object is. Of a can, of whose shape any turn is open, those near the estimate
    are compared alone: the frame before tells the rest.

    Args:
        texture: Decides the turn.
    """

    def __init__(self, texture: TextureRotations) -> None:
        self.texture = texture

    @torch.no_grad()
    def __call__(
        self, belief: BeliefBatch, encoding: Encoding, method: Method, generator: Generator
    ) -> BeliefBatch:
        """Return the belief, turned; the score stays."""
        best = self.texture.rotate_nearby(belief.best, encoding, method)
        if best is None:
            best = self.texture(belief, encoding, method, generator).best
        turn = torch.linalg.inv(belief.best) @ best  # in the object's frame
        return belief._replace(best=best, poses=belief.poses @ turn[:, None])
