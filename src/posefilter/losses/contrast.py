"""Contrast: the true pose must outscore the others of the same image, as far as the noise level can
tell them apart.
"""

import torch
from torch import Tensor

from posefilter.errors import UserError
from posefilter.geometry.pose_error import deviation, thin
from posefilter.types import Batch, ObjectModel, Trace


def pose_distance(poses: Tensor, truth: Tensor, model: ObjectModel, points: int = 64) -> Tensor:
    """Return the mean distance of corresponding points, least over the object's symmetries.

    (B, N, 4, 4), (B, 4, 4) -> (B, N) [m]. ADD (Hinterstoisser et al. 2012) on a thinned set of
    points; for symmetric objects MSSD's way of taking the minimum over equivalent truths (Hodan et
    al. 2020) with ADD's mean.
    """
    few = thin(model.points, points).to(poses.device)
    options = [
        deviation(poses, truth @ symmetry, few) for symmetry in model.symmetries.to(poses.device)
    ]
    return torch.stack(options).amin(0)


class Contrast:
    """KL(target || softmax(score)) over one image's candidates; target ~ exp(-ADD^2 / (2 sigma^2)).

    With it exp(score) learns to be the posterior smoothed by sigma, the noise level that the
    candidates were read at. Images in which the object is not seen teach nothing and count zero.
    """

    def __call__(self, trace: Trace, batch: Batch, model: ObjectModel) -> Tensor:
        """Return the divergence an image, (B,) >= 0."""
        if trace.particles[-1].state.dim() != 4:
            raise UserError(
                "loss=contrast judges candidate poses, not points: choose "
                "model/candidate_sampler=candidates, or loss=regression"
            )
        poses, scores, sigma = (
            trace.outputs[-1].pose,
            trace.outputs[-1].log_likelihood,
            trace.steps[-1].sigma,
        )
        distance = pose_distance(poses, batch.camera_from_object, model)
        target = torch.log_softmax(-0.5 * (distance / sigma[..., None]) ** 2, dim=1)
        divergence = (target.exp() * (target - torch.log_softmax(scores, dim=1))).sum(1)
        return divergence * batch.mask.flatten(1).any(1)
