"""The Falling Things (FAT) format: its constants, and writing it.

A folder holds `_object_settings.json`, `_camera_settings.json` and for each frame and camera
`NNNNNN.left.jpg`, `.json`, `.depth.png` and `.seg.png`. Lengths in the JSON files are centimeters,
depth images are 0.1 mm a unit. Poses are of an *aligned* object frame: y down, centered on the
bounding box. Each folder's `fixed_model_transform` F maps the mesh there, for row vectors:
p_aligned_cm = [x y z 1] @ F.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from posefilter.files import write_whole
from posefilter.geometry.rigid import rigid
from posefilter.geometry.rotation import quat_xyzw_from_matrix
from posefilter.meshes.mesh import Mesh
from posefilter.rendering.surfaces import project

CM = 100.0  # centimeters a meter
DEPTH_UNITS = 10_000.0  # depth image units a meter
BASELINE = 0.06  # [m] from the left camera to the right
CLASS_SUFFIX = "_16k"
OBJECT_SETTINGS = "_object_settings.json"
CAMERA_SETTINGS = "_camera_settings.json"
# the order of a cuboid's corners, in the aligned frame
_ROUND = ((1, -1), (-1, -1), (-1, 1), (1, 1))
CUBOID_SIGNS = np.array([[x, y, z] for z in (1.0, -1.0) for x, y in _ROUND])
# z up -> y down, as FAT's cracker box has it
_ALIGNED_FROM_UPRIGHT = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


@dataclass(frozen=True, eq=False)
class ExportedObject:
    """An object class, as in a folder's settings."""

    name: str  # without FAT's suffix
    seg_id: int
    aligned_from_mesh: np.ndarray  # (4, 4) rigid [m], column vectors
    dimensions: np.ndarray  # (3,) of the cuboid [m], aligned axes

    @property
    def fat_class(self) -> str:
        """The class's name in FAT."""
        return self.name + CLASS_SUFFIX


@dataclass(frozen=True, eq=False)
class ObjectInFrame:
    """One object of one frame."""

    exported: ExportedObject
    camera_from_object: np.ndarray  # (4, 4) [m], mesh frame
    visibility: float  # visible fraction of the pixels that it would have alone
    truncated: float  # fraction of its outline that is out of the frame


def export_object(mesh: Mesh, seg_id: int) -> ExportedObject:
    """Return a mesh's class; its aligned frame is centered on the bounding box, y down."""
    center = mesh.bounds.mean(0)
    aligned = rigid(_ALIGNED_FROM_UPRIGHT, -_ALIGNED_FROM_UPRIGHT @ center)
    sides = np.abs(_ALIGNED_FROM_UPRIGHT @ (mesh.bounds[1] - mesh.bounds[0]))
    return ExportedObject(mesh.name, seg_id, aligned, sides)


def object_settings(objects: Sequence[ExportedObject]) -> dict[str, Any]:
    """Return the content of `_object_settings.json`."""
    exported = []
    for one in objects:
        F = one.aligned_from_mesh.T.copy()
        F[:, :3] *= CM
        entry = {
            "class": one.fat_class,
            "segmentation_class_id": one.seg_id,
            "fixed_model_transform": _numbers(F, 7),
            "cuboid_dimensions": _numbers(one.dimensions * CM, 6),
        }
        exported.append(entry)
    return {
        "exported_object_classes": [one.fat_class for one in objects],
        "exported_objects": exported,
    }


def camera_settings(
    K: np.ndarray, height: int, width: int, cameras: Sequence[str]
) -> dict[str, Any]:
    """Return the content of `_camera_settings.json`; K (3, 3) and sizes in pixels."""
    one = {
        "horizontal_fov": float(np.rad2deg(2 * np.arctan(width / 2 / K[0, 0]))),
        "intrinsic_settings": {
            "fx": float(K[0, 0]),
            "fy": float(K[1, 1]),
            "cx": float(K[0, 2]),
            "cy": float(K[1, 2]),
            "s": 0,
        },
        "captured_image_size": {"width": width, "height": height},
    }
    return {"camera_settings": [{"name": name, **one} for name in cameras]}


def frame_record(
    objects: Sequence[ObjectInFrame], K: np.ndarray, right: float = 0.0
) -> dict[str, Any]:
    """Return the content of a frame's JSON file.

    The world frame (left-handed, x forward, y right, z up, centimeters) is that of the left camera.

    Args:
        objects: The objects of the frame.
        K: (3, 3) camera matrix [px].
        right: How far right of the left camera this one stands [m].
    """
    camera = {
        "location_worldframe": [0.0, right * CM, 0.0],
        "quaternion_xyzw_worldframe": [0.0, 0.0, 0.0, 1.0],
    }
    return {"camera_data": camera, "objects": [_object_record(one, K) for one in objects]}


def _object_record(one: ObjectInFrame, K: np.ndarray) -> dict[str, Any]:
    camera_from_aligned = one.camera_from_object @ np.linalg.inv(one.exported.aligned_from_mesh)
    R, t = camera_from_aligned[:3, :3], camera_from_aligned[:3, 3]
    corners = (CUBOID_SIGNS * one.exported.dimensions / 2) @ R.T + t
    pixels = project(corners, K)
    # aligned axes permuted as the exporter does: x' = z, y' = x, z' = -y; row vectors
    permuted = np.eye(4)
    permuted[:3, :3] = np.stack([R[:, 2], R[:, 0], -R[:, 1]])
    permuted[3, :3] = t * CM
    low, high = pixels.min(0)[::-1], pixels.max(0)[::-1]
    return {
        "class": one.exported.fat_class,
        "visibility": round(float(one.visibility), 4),
        "truncated": round(float(one.truncated), 4),
        "location": _numbers(t * CM, 6),
        "quaternion_xyzw": _numbers(quat_xyzw_from_matrix(torch.from_numpy(R.copy())).numpy(), 9),
        "pose_transform_permuted": _numbers(permuted, 6),
        "cuboid_centroid": _numbers(t * CM, 6),
        "projected_cuboid_centroid": _numbers(project(t[None], K)[0], 4),
        "bounding_box": {"top_left": _numbers(low, 4), "bottom_right": _numbers(high, 4)},
        "cuboid": _numbers(corners * CM, 6),
        "projected_cuboid": _numbers(pixels, 4),
    }


def write_image(path: Path, image: np.ndarray) -> None:
    """Write a JPEG (from RGB) or a PNG, by the path's suffix; all of the file or nothing.

    Raises:
        UserError: It cannot be written.
    """
    if path.suffix == ".jpg":
        ok, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    else:
        ok, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 2])
    assert ok
    write_whole(path, data.tobytes())


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write JSON; all of the file or nothing."""
    write_whole(path, json.dumps(content, indent=1) + "\n")


def depth_units(depth: np.ndarray) -> np.ndarray:
    """Encode depth.

    Args:
        depth: (H, W) [m].

    Returns:
        (H, W) uint16 in 0.1 mm; 0 where there is nothing, and beyond 6.5535 m.
    """
    units = np.round(depth * DEPTH_UNITS)
    return np.where(units > 65535, 0, units).astype(np.uint16)


def _numbers(array: np.ndarray, decimals: int) -> Any:
    """Return nested lists of floats with so many decimals."""
    return (np.round(np.asarray(array, dtype=np.float64), decimals) + 0.0).tolist()
