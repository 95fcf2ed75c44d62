"""The loss of a posterior over crops and rotations of a grid."""

from typing import ClassVar

import torch
from torch import Tensor

from posefilter.capabilities import Capabilities
from posefilter.geometry.crops import look_at
from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.types import Batch, ObjectModel, Trace


def squared_distances(
    centers: Tensor, rotations: Tensor, truth: Tensor, object_model: ObjectModel
) -> Tensor:
    """Return how far the pose of each center and rotation is from the truth, squared.

    Shift, and angle x radius, to the nearest of the poses that a symmetry makes equal.

    (B, C, 3) [m], (M, 3, 3), (B, 4, 4) -> (B, C, M) [m^2].
    """
    equivalent = truth[:, None] @ object_model.symmetries.to(truth)  # (B, S, 4, 4)
    # a symmetry may move the center, which is that of a box
    origin = origin_of(equivalent, object_model.center.to(truth))
    shift = (centers[:, :, None] - origin[:, None]).square().sum(-1)
    rotation = look_at(centers).mT[:, :, None] @ rotation_of(equivalent)[:, None]
    trace = torch.einsum("bcsij,mij->bcsm", rotation, rotations)
    angle = ((trace - 1) / 2).clamp(-1, 1).acos()
    return (shift[..., None] + (object_model.radius * angle).square()).amin(2)


class GridPosterior:
    """Divergence of the posterior over (crop, rotation) from a Gaussian about the true pose.

    One softmax over all pairs of an image learns both what a particle's likelihood must tell: which
    translation is right, and which rotation, given one.

    The trace's encoding has `scores` (B, C, M), the log likelihoods of rotation m, given that crop
    c is about the object; `centers` (B, C, 3), where the crops are about [m]; and `rotations`
    (M, 3, 3) of the object, relative to a camera that looks at its center.

    Args:
        sigma: Standard deviation of the Gaussian, in radii of the object.
    """

    requires: ClassVar[Capabilities] = ("grid_scores",)

    def __init__(self, sigma: float = 0.15) -> None:
        self.sigma = sigma

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return the loss of each image, (B,); 0 of one that does not show the object."""
        encoding = trace.encoding
        distance = squared_distances(
            encoding.centers, encoding.rotations, batch.camera_from_object, object_model
        )
        log_kernel = -0.5 * distance / (self.sigma * object_model.radius) ** 2
        log_target = log_kernel.flatten(1).log_softmax(1)
        log_posterior: Tensor = encoding.scores.flatten(1).log_softmax(1)
        divergence = (log_target.exp() * (log_target - log_posterior)).sum(1)
        return divergence * batch.mask.flatten(1).any(1)
