"""Contrastive loss: the true pose must score higher than other poses of the same image."""

from typing import ClassVar

import torch
from torch import Tensor

from posefilter.capabilities import Capabilities
from posefilter.geometry.pose_error import add_distance, subsample
from posefilter.types import Batch, ObjectModel, Trace


def pose_distance(
    poses: Tensor, truth: Tensor, object_model: ObjectModel, points: int = 64
) -> Tensor:
    """Return the least mean distance of corresponding points over the object's symmetries.

    ADD (Hinterstoisser et al. 2012) on a subset of the points. As in MSSD (Hodan et al. 2020), the
    minimum is taken over equivalent true poses.

    Args:
        poses: (B, N, 4, 4) camera_from_object.
        truth: (B, 4, 4) camera_from_object.
        object_model: The object with its symmetries.
        points: Number of points.

    Returns:
        Distances (B, N) [m].
    """
    few = subsample(object_model.points, points).to(poses.device)
    group = object_model.symmetries.to(poses.device)
    options = [add_distance(poses, truth @ symmetry, few) for symmetry in group]
    return torch.stack(options).amin(0)


class Contrastive:
    """KL(target || softmax(score)) over an image's candidates; target ~ exp(-ADD^2 / (2 sigma^2)).

    At its minimum exp(score) is proportional to p / q: p is the posterior smoothed by sigma, the
    noise level of the scores, and q the density of the candidates, as in noise-contrastive
    estimation (Gutmann and Hyvarinen 2010). Where q peaks at the modes of p, as the candidates of
    `pose_pf` do, the score is flatter than log p. The loss is zero for images in which the object
    is not visible.
    """

    requires: ClassVar[Capabilities] = ("candidates",)

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return the divergence of each image, (B,) >= 0."""
        poses = trace.outputs[-1].pose
        scores = trace.outputs[-1].log_likelihood
        sigma = trace.steps[-1].sigma
        distance = pose_distance(poses, batch.camera_from_object, object_model)
        target = torch.log_softmax(-0.5 * (distance / sigma[..., None]) ** 2, dim=1)
        divergence = (target.exp() * (target - torch.log_softmax(scores, dim=1))).sum(1)
        return divergence * batch.mask.flatten(1).any(1)
