"""First and second moments of weighted poses.

A twist (6,) is `[shift, turn]`: the shift of the object's center in the camera's axes [m], and the
rotation vector of the turn about that center in the object's own axes [rad].  It is the tangent
that `move_about` takes.
"""

import torch
from torch import Tensor

from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.geometry.rotation import log_so3


def twist_between(start: Tensor, end: Tensor, center_object: Tensor) -> Tensor:
    """Return the twist that moves one pose to another, the inverse of `move_about`.

    Args:
        start: Poses (*, 4, 4) camera_from_object [m].
        end: Poses (*, 4, 4) likewise; leading shapes broadcast.
        center_object: The object's center (3,) in its own frame [m].

    Returns:
        Twists (*, 6) as [shift [m], turn [rad]]; the turn's angle is in [0, pi].
    """
    shift = origin_of(end, center_object) - origin_of(start, center_object)
    turn = log_so3(rotation_of(start).mT @ rotation_of(end))
    return torch.cat([shift, turn], dim=-1)


def covariance_about(pose: Tensor, poses: Tensor, weights: Tensor, center_object: Tensor) -> Tensor:
    """Return the weighted covariance of the twists that move a pose to each of many.

    It is taken about `pose`, not about the twists' own mean, so that it also holds the offset of a
    pose that is not the mean.

    Args:
        pose: The pose (*, 4, 4) that the twists start from.
        poses: Poses (*, N, 4, 4) camera_from_object [m].
        weights: Weights (*, N) that sum to 1.
        center_object: The object's center (3,) in its own frame [m].

    Returns:
        Covariances (*, 6, 6), symmetric, in [m^2], [m rad] and [rad^2].
    """
    twist = twist_between(pose[..., None, :, :], poses, center_object)
    return (weights[..., None] * twist).mT @ twist
