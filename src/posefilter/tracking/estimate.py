"""The estimate of a tracked pose: a mean over the mode, and its smoothing over time."""

import torch
from torch import Generator, Tensor

from posefilter.geometry.pose import take_poses
from posefilter.geometry.pose_statistics import twist_between
from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Encoding, Method
from posefilter.types import BeliefBatch, ParticleOutput, Particles


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
