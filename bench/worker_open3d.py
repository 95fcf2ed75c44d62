"""Open3D on one image: FPFH features, RANSAC on their matches, then point-to-plane ICP.

Clouds are in meters, in the camera's frame. What is asked for are files of NumPy, see
peer_images.py.
"""

import platform
import time
from typing import Any

import numpy as np
import open3d as o3d
from peer_clouds import Frame, back_project, read_frame, read_model
from peer_process import serve

REGISTRATION = o3d.pipelines.registration
MODELS: dict[tuple[str, float], tuple[Any, Any]] = {}


def make_cloud(points: np.ndarray, normals: np.ndarray | None = None) -> Any:
    """Return Open3D's cloud of points (N, 3)."""
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    if normals is not None:
        cloud.normals = o3d.utility.Vector3dVector(normals)
    return cloud


def describe(cloud: Any, voxel: float) -> Any:
    """Return the FPFH features of a cloud that has normals."""
    radius = o3d.geometry.KDTreeSearchParamHybrid(radius=5 * voxel, max_nn=100)
    return REGISTRATION.compute_fpfh_feature(cloud, radius)


def prepare_model(path: str, voxel: float) -> tuple[Any, Any]:
    """Return the model's cloud and features, computed once."""
    if (path, voxel) not in MODELS:
        cloud = make_cloud(*read_model(path)).voxel_down_sample(voxel)
        MODELS[path, voxel] = cloud, describe(cloud, voxel)
    return MODELS[path, voxel]


def prepare_scene(frame: Frame, voxel: float, masked: bool, planes: int) -> Any:
    """Return the scene's cloud with normals; without its largest planes if that is asked for."""
    cloud = make_cloud(back_project(frame, masked)).voxel_down_sample(voxel)
    for _ in range(planes):
        _, inside = cloud.segment_plane(1.5 * voxel, 3, 200)
        # what is left must be able to hold the object
        if len(cloud.points) - len(inside) < 200:
            break
        cloud = cloud.select_by_index(inside, invert=True)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=2 * voxel, max_nn=30))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    return cloud


def estimate(
    model: str,
    frame: str,
    masked: bool,
    voxel: float,
    iterations: int,
    mutual: bool,
    planes: int,
    seed: int = 0,
) -> dict[str, Any]:
    """Return the pose (4, 4), and what it took.

    Args:
        model: File of the model's points and normals.
        frame: File of the image.
        masked: Whether the object's mask is told.
        voxel: Side of the voxels [m].
        iterations: Of RANSAC, at most.
        mutual: Whether features must be each other's nearest.
        planes: Planes that are removed from the scene.
        seed: Of RANSAC.
    """
    own, features = prepare_model(model, voxel)
    image = read_frame(frame)
    o3d.utility.random.seed(seed)
    wall, cpu = time.perf_counter(), time.process_time()
    scene = prepare_scene(image, voxel, masked, 0 if masked else planes)
    found = REGISTRATION.registration_ransac_based_on_feature_matching(
        own,
        scene,
        features,
        describe(scene, voxel),
        mutual,
        1.5 * voxel,
        REGISTRATION.TransformationEstimationPointToPoint(False),
        3,
        [
            REGISTRATION.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            REGISTRATION.CorrespondenceCheckerBasedOnDistance(1.5 * voxel),
        ],
        REGISTRATION.RANSACConvergenceCriteria(iterations, 0.999),
    )
    pose = found.transformation
    for reach in (2 * voxel, voxel):
        pose = REGISTRATION.registration_icp(
            own,
            scene,
            reach,
            pose,
            REGISTRATION.TransformationEstimationPointToPlane(),
            REGISTRATION.ICPConvergenceCriteria(max_iteration=50),
        ).transformation
    return {
        "pose": np.asarray(pose).tolist(),
        "seconds": time.perf_counter() - wall,
        "cpu": time.process_time() - cpu,
    }


if __name__ == "__main__":
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    found = f"Open3D {o3d.__version__}, Python {platform.python_version()}"
    serve({"versions": found}, {"estimate": estimate})
