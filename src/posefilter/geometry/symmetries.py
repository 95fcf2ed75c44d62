"""Equivalent poses: what the symmetries of an object make of a pose."""

import math

import torch
from torch import Tensor

from posefilter.geometry.pose import (
    invert,
    origin_of,
    pose_about,
    rotation_of,
    transform,
    translation_of,
)
from posefilter.geometry.rotation import exp_so3, log_so3, quat_xyzw_from_matrix

# [rad] a group whose least turn is smaller stands for a continuous symmetry
_CONTINUOUS = math.radians(15.0)
_STEP = math.radians(1.2)  # the challenge cuts a continuous symmetry into 315 turns


def densify(symmetries: Tensor, step: float = _STEP) -> Tensor:
    """Fill in the turns between those that stand for a continuous symmetry.

    An object knows a continuous symmetry by few turns, which would count a pose between two of
    them as an error.

    Args:
        symmetries: (S, 4, 4) object_from_object.
        step: The largest angle between neighbors [rad].

    Returns:
        (S', 4, 4); as given where no turn is smaller than 15 degrees, and for a ball.
    """
    if is_ball(symmetries):
        return symmetries
    turns = log_so3(rotation_of(symmetries))
    angles = turns.norm(dim=-1)
    least = angles.masked_fill(angles < 1e-4, torch.inf).argmin()
    if not 1e-4 < float(angles[least]) < _CONTINUOUS:
        return symmetries
    count = math.ceil(float(angles[least]) / step)
    # the axis is where the turn leaves points as they are: (I - R) c = t, least squares
    R, t = rotation_of(symmetries[least]), translation_of(symmetries[least])
    point = torch.linalg.pinv(torch.eye(3).to(R) - R, rtol=1e-4) @ t
    parts = []
    for k in range(count):
        part = torch.eye(4).to(symmetries)
        part[:3, :3] = exp_so3(turns[least] * (k / count))
        part[:3, 3] = point - part[:3, :3] @ point
        parts.append(symmetries @ part)
    return torch.cat(parts)


def spread_turns(poses: Tensor, symmetries: Tensor) -> Tensor:
    """Return poses, of an object with a continuous symmetry turned about its axis by up to half the
    least of its turns to either side.

    A density knows such an object by few turns, and poses about one alone would leave gaps between
    them.

    Args:
        poses: (N, 4, 4) camera_from_object [m]; two that follow each other are turned alike.
        symmetries: (S, 4, 4) object_from_object.

    Returns:
        (N, 4, 4); as given without a continuous symmetry.
    """
    between = densify(symmetries)[:: len(symmetries)]  # the turns from one to the next
    if len(between) == 1:
        return poses
    between = invert(between[len(between) // 2]) @ between
    return poses @ between[torch.arange(len(poses)) // 2 % len(between)]


def is_ball(symmetries: Tensor) -> bool:
    """Tell whether symmetries (S, 4, 4) stand for all rotations about a point.

    The mean square of the trace is then 1. It is 2 or more where one axis is left, and of the
    finite groups of which it is 1 the largest is the icosahedron's, of 60.
    """
    if len(symmetries) <= 60:
        return False
    traces = rotation_of(symmetries).diagonal(dim1=-2, dim2=-1).sum(-1)
    return bool(traces.square().mean() < 1.5)


def list_equivalent(poses: Tensor, truth: Tensor, symmetries: Tensor) -> Tensor:
    """Return the poses equivalent to a true one, of which one is nearest to the estimate: all that
    are known, and of a ball the one that is turned as the estimate is.

    Args:
        poses: (*, 4, 4) estimates, camera_from_object [m].
        truth: (*, 4, 4).
        symmetries: (S, 4, 4) object_from_object, the identity among them.

    Returns:
        (*, S', 4, 4).
    """
    symmetries = symmetries.to(truth)
    if not is_ball(symmetries):
        return truth[..., None, :, :] @ symmetries
    center = find_center(symmetries)
    return pose_about(rotation_of(poses), origin_of(truth, center), center)[..., None, :, :]


def find_center(symmetries: Tensor) -> Tensor:
    """Return the point that symmetries (S, 4, 4) of a ball leave where it is.  -> (3,)."""
    R, t = rotation_of(symmetries), translation_of(symmetries)  # (I - R) c = t, least squares
    return torch.linalg.pinv((torch.eye(3).to(R) - R).flatten(0, 1)) @ t.flatten()


def gather_copies(
    poses: Tensor, about: Tensor, center: Tensor, radius: float, group: Tensor
) -> Tensor:
    """Return of each pose the equivalent one that lies nearest to a pose: of a ball the one that is
    turned as it is.

    Args:
        poses: (N, 4, 4) camera_from_object [m].
        about: (4, 4) likewise.
        center: (3,) the object's center in its frame [m].
        radius: Distance at which a turn counts as the shift that it causes [m].
        group: (S, 4, 4) object_from_object, the identity first.

    Returns:
        (N, 4, 4) [m].
    """
    if len(group) == 1:
        return poses
    if is_ball(group):
        own = find_center(group)
        rotation = rotation_of(about).expand_as(rotation_of(poses))
        return pose_about(rotation, origin_of(poses, own), own)
    # N S matrices would take long: an angle takes no more than the real part of a quaternion
    relative = quat_xyzw_from_matrix(rotation_of(about).mT @ rotation_of(poses))
    turns = quat_xyzw_from_matrix(rotation_of(group))
    real = relative @ (turns * turns.new_tensor([-1.0, -1.0, -1.0, 1.0])).mT  # of their products
    arc = 2 * radius * real.abs().clamp_max(1).acos()
    shift = transform(poses, origin_of(group, center)) - origin_of(about, center)
    nearest = (shift.square().sum(-1) + arc.square()).argmin(1)
    return poses @ group[nearest]
