"""Results as vision_msgs/Detection3DArray."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from posefilter.geometry.rotation import hat, quat_xyzw_from_matrix
from posefilter.result import Result
from posefilter.ros.messages import DETECTIONS, make_message


def to_ros_covariance(covariance: np.ndarray, pose: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Return a covariance in ROS's convention.

    ROS has the position of the object frame's origin [m] and a turn about the camera's fixed axes
    [rad]; ours are the shift of the object's center in the camera's axes and a turn about that
    center in the object's.  A turn w about the center, in the object's axes, moves the origin by
    R [center] w.

    Args:
        covariance: (6, 6) as `Belief.covariance`.
        pose: (4, 4) camera_from_object [m], about which it is.
        center: (3,) the object's center in its own frame [m].

    Returns:
        (6, 6), rows and columns [x, y, z, rotation about x, y, z].
    """
    R = pose[:3, :3]
    J = np.eye(6)
    J[:3, 3:] = R @ hat(torch.from_numpy(np.asarray(center, dtype=np.float64))).numpy()
    J[3:, 3:] = R
    return np.asarray(J @ covariance @ J.T)


def list_shown(results: Sequence[Result]) -> list[Result]:
    """Return the results of objects that are not absent; of tracks, those that are not lost, in an
    image that can be judged: in another one the pose is predicted, and a detection cannot say so.
    """
    return [
        one for one in results
        if not one.blank and getattr(one, "is_tracked", one.verdict != "absent")
    ]  # fmt: skip


def choose_score(result: Result) -> float:
    """Return the calibrated probability of a detection; NaN where there is none, or where it does
    not hold, since depth or intrinsics must be wrong: a detection carries no verdict.
    """
    doubted = result.wrong_size or bool(result.blank)
    return math.nan if result.probability is None or doubted else float(result.probability)


def make_quaternion(pose: np.ndarray) -> list[float]:
    """Return the rotation of a pose (4, 4) as a quaternion [x, y, z, w]."""
    R = torch.from_numpy(pose[:3, :3].astype(np.float64))
    return [float(value) for value in quat_xyzw_from_matrix(R)]


def measure_box(result: Result) -> tuple[np.ndarray, list[float]]:
    """Return the box of an object's surface points along the axes of its own frame.

    Returns:
        Its pose (4, 4) in the camera's frame, at the box's center, and its size along x, y, z [m].
    """
    points = result.object_model.points.detach().cpu().double().numpy()
    low, high = points.min(0), points.max(0)
    center = result.pose.copy()
    center[:3, 3] += result.pose[:3, :3] @ ((low + high) / 2)
    return center, (high - low).tolist()


def make_detections(results: Sequence[Result], header: Any) -> Any:
    """Return a Detection3DArray with a detection for each object but those that are absent, or
    whose track is lost.

    A detection's hypothesis has the score of `choose_score`, and the pose of the object's frame,
    that of its mesh file. Its box is the object's own.

    Args:
        results: Of one image, an object each.
        header: Of the color image: time and the camera's optical frame.
    """
    made = [_make_detection(one, header) for one in list_shown(results)]
    return make_message(DETECTIONS, header=header, detections=made)


def _make_detection(result: Result, header: Any) -> Any:
    # a consumer takes it for that of the pose beside it
    covariance = to_ros_covariance(result.covariance, result.pose, result.belief.center)
    center, (x, y, z) = measure_box(result)
    hypothesis = make_message(
        "vision_msgs/msg/ObjectHypothesis", class_id=result.object, score=choose_score(result)
    )
    pose = make_message(
        "geometry_msgs/msg/PoseWithCovariance",
        pose=_make_pose(result.pose),
        covariance=covariance.reshape(36),
    )
    box = make_message(
        "vision_msgs/msg/BoundingBox3D",
        center=_make_pose(center),
        size=make_message("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
    )
    whole = make_message(
        "vision_msgs/msg/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=pose
    )
    return make_message(
        "vision_msgs/msg/Detection3D", header=header, results=[whole], bbox=box, id=result.object
    )


def _make_pose(pose: np.ndarray) -> Any:
    x, y, z, w = make_quaternion(pose)
    place = dict(zip("xyz", pose[:3, 3].tolist(), strict=True))
    return make_message(
        "geometry_msgs/msg/Pose",
        position=make_message("geometry_msgs/msg/Point", **place),
        orientation=make_message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
    )
