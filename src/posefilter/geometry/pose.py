"""Rigid transforms as homogeneous matrices (*, 4, 4).

`a_from_b` maps b into a, so neighbors cancel when multiplied.
"""

import torch
from torch import Tensor

from posefilter.geometry.rotation import exp_so3, project_to_so3


def make_pose(rotation: Tensor, translation: Tensor) -> Tensor:
    """Assemble a pose.  (*, 3, 3), (*, 3) [m] -> (*, 4, 4); leading shapes broadcast."""
    # not torch.broadcast_shapes, which imports sympy
    lead = torch.broadcast_tensors(rotation[..., 0], translation)[0].shape[:-1]
    top = torch.cat([rotation.expand(*lead, 3, 3), translation.expand(*lead, 3)[..., None]], dim=-1)
    # made on the device: a GPU that records a graph takes nothing from elsewhere
    bottom = torch.eye(4, dtype=top.dtype, device=top.device)[3:].expand(*lead, 1, 4)
    return torch.cat([top, bottom], dim=-2)


def rotation_of(pose: Tensor) -> Tensor:
    """Return the rotation block.  (*, 4, 4) -> (*, 3, 3)."""
    return pose[..., :3, :3]


def translation_of(pose: Tensor) -> Tensor:
    """Return the translation column.  (*, 4, 4) -> (*, 3) [m]."""
    return pose[..., :3, 3]


def invert(a_from_b: Tensor) -> Tensor:
    """Return b_from_a.  (*, 4, 4) -> (*, 4, 4)."""
    Rt = rotation_of(a_from_b).transpose(-1, -2)
    return make_pose(Rt, -(Rt @ translation_of(a_from_b)[..., None])[..., 0])


def transform(a_from_b: Tensor, points_b: Tensor) -> Tensor:
    """Map points of frame b into frame a.  (*, 4, 4), (*, P, 3) [m] -> (*, P, 3) [m]."""
    return points_b @ rotation_of(a_from_b).mT + translation_of(a_from_b)[..., None, :]


def take_poses(poses: Tensor, index: Tensor) -> Tensor:
    """Return some of each image's poses.  (B, N, 4, 4), (B, M) int64 -> (B, M, 4, 4)."""
    return poses.gather(1, index[..., None, None].expand(-1, -1, 4, 4))


def origin_of(pose: Tensor, point: Tensor) -> Tensor:
    """Return the position of one object point in the camera.  (*, 4, 4), (3,) [m] -> (*, 3) [m]."""
    return rotation_of(pose) @ point + translation_of(pose)


def pose_about(rotation: Tensor, center_camera: Tensor, center_object: Tensor) -> Tensor:
    """Return the pose of a rotation that maps `center_object` to `center_camera`.  -> (*, 4, 4)."""
    return make_pose(rotation, center_camera - rotation @ center_object)


def move_about(pose: Tensor, tangent: Tensor, center_object: Tensor) -> Tensor:
    """Move poses by tangent vectors: rotation about the object's center, translation in the camera.

    Rotation about the center, rather than the origin of the mesh's frame, keeps both parts
    independent of each other.

    Args:
        pose: (*, 4, 4) camera_from_object [m].
        tangent: (*, 6), translation [m] in the camera's axes, then rotation vector [rad] in the
            object's axes.
        center_object: (3,) the object's center [m].

    Returns:
        Moved poses (*, 4, 4).
    """
    rotation = rotation_of(pose) @ exp_so3(tangent[..., 3:])
    return pose_about(rotation, origin_of(pose, center_object) + tangent[..., :3], center_object)


def fit_rigid(source: Tensor, target: Tensor, weights: Tensor) -> Tensor:
    """Return the rigid transform of least weighted squared error (Kabsch 1976; Umeyama 1991).

    Args:
        source: (*, P, 3) points [m].
        target: (*, P, 3) corresponding points [m].
        weights: (*, P) >= 0.

    Returns:
        target_from_source (*, 4, 4); for degenerate sets one of the minimizers.
    """
    w = (weights / weights.sum(-1, keepdim=True).clamp_min(1e-12))[..., None]
    mean_s = (w * source).sum(-2, keepdim=True)
    mean_t = (w * target).sum(-2, keepdim=True)
    cross = ((target - mean_t) * w).transpose(-1, -2) @ (source - mean_s)
    R = project_to_so3(cross)
    return make_pose(R, (mean_t - mean_s @ R.transpose(-1, -2))[..., 0, :])


def is_rigid(pose: Tensor, tolerance: float = 1e-3) -> bool:
    """Return whether every matrix is a proper rigid transform, within `tolerance` per entry."""
    R = rotation_of(pose)
    eye = torch.eye(3, dtype=pose.dtype, device=pose.device)
    orthonormal = bool(((R @ R.transpose(-1, -2) - eye).abs() < tolerance).all())
    proper = bool((torch.det(R) > 0).all())
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=pose.dtype, device=pose.device)
    return orthonormal and proper and bool(((pose[..., 3, :] - bottom).abs() < tolerance).all())
