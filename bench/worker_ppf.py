"""OpenCV's point pair features (`cv2.ppf_match_3d` of opencv-contrib), then its ICP.

Drost, Ulrich, Navab, Ilic: Model globally, match locally. CVPR 2010. Clouds are in millimeters, as
in OpenCV's own sample.
"""

import platform
import time
from typing import Any

import cv2
import numpy as np
from peer_clouds import back_project, read_frame, read_model, thin
from peer_process import serve
from scipy.spatial import cKDTree

PPF = cv2.ppf_match_3d
MODELS: dict[tuple[str, float], tuple[np.ndarray, Any]] = {}
NEIGHBORS = 12  # for normals
ICP_POINTS = 10  # of the model's, one in so many


def prepare_model(path: str, step: float) -> tuple[np.ndarray, Any]:
    """Return the model's cloud (N, 6) [mm] and its trained detector, made once."""
    if (path, step) not in MODELS:
        points, normals = read_model(path)
        cloud = np.concatenate([1000 * points, normals], axis=1).astype(np.float32)
        detector = PPF.PPF3DDetector(step, step, 30)
        detector.trainModel(cloud)
        MODELS[path, step] = cloud, detector
    return MODELS[path, step]


def estimate(
    model: str,
    frame: str,
    masked: bool,
    step: float,
    share: float,
    best: int,
    pick: str,
    dense: float = 3.0,
) -> dict[str, Any]:
    """Return the pose (4, 4) [m], and what it took.

    Args:
        model: File of the model's points and normals.
        frame: File of the image.
        masked: Whether the object's mask is told.
        step: Spacing of the points, over the model's diameter.
        share: Share of the scene's points that vote.
        best: Poses that ICP refines.
        pick: "votes": the first of them; "support": the one with the most scene points near it.
        dense: Voxels of the cloud that normals and ICP have [mm].
    """
    cloud, detector = prepare_model(model, step)
    image = read_frame(frame)
    wall, cpu = time.perf_counter(), time.process_time()
    points = thin(1000 * back_project(image, masked), dense).astype(np.float32)
    _, scene = PPF.computeNormalsPC3d(points, NEIGHBORS, True, (0.0, 0.0, 0.0))
    scene = scene[np.isfinite(scene).all(1)]
    # the detector thins by shares of the scene's own extent: as densely as it thins the model
    diameter = float(np.linalg.norm(np.ptp(cloud[:, :3], axis=0)))
    extent = float(np.ptp(scene[:, :3], axis=0).max())
    spacing = max(step * diameter / extent, 0.004)
    found = list(detector.match(scene, share, spacing))[:best]
    poses = []
    if found:
        icp = PPF.ICP(100, 0.005, 2.5, 6)
        _, refined = icp.registerModelToScene(cloud[::ICP_POINTS], scene, found)
        poses = [np.asarray(one.pose) for one in refined]
    if not poses:
        pose = np.eye(4)
    elif pick == "votes" or len(poses) == 1:
        pose = poses[0]
    else:
        pose = max(poses, key=lambda one: measure_support(one, cloud, scene, 0.02 * diameter))
    pose = pose.copy()
    pose[:3, 3] /= 1000
    return {
        "pose": pose.tolist(),
        "seconds": time.perf_counter() - wall,
        "cpu": time.process_time() - cpu,
    }


def measure_support(pose: np.ndarray, model: np.ndarray, scene: np.ndarray, near: float) -> float:
    """Return the share of the model's points that face the camera and have a scene point near."""
    points = model[::10, :3] @ pose[:3, :3].T + pose[:3, 3]
    normals = model[::10, 3:] @ pose[:3, :3].T
    faces = (points * normals).sum(1) < 0
    if not faces.any():
        return 0.0
    distance, _ = cKDTree(scene[:, :3]).query(points[faces], distance_upper_bound=near)
    return float(np.isfinite(distance).mean())


if __name__ == "__main__":
    cv2.setNumThreads(1)
    found = f"OpenCV contrib {cv2.__version__}, Python {platform.python_version()}"
    serve({"versions": found}, {"estimate": estimate})
