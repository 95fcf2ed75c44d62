"""Small datasets with analytic truth: an L of two boxes, its depth by intersecting rays with
slabs.
"""

import json
from pathlib import Path

import cv2
import numpy as np
import scipy.io
from scipy.spatial.transform import Rotation

# [m], off the origin
BOXES = [((0.02, -0.01, 0.03), (0.12, 0.05, 0.09)), ((0.02, -0.01, 0.09), (0.05, 0.05, 0.17))]
LOW, HIGH = np.array([0.02, -0.01, 0.03]), np.array([0.12, 0.05, 0.17])
HEIGHT, WIDTH = 120, 160
K = np.array([[190.0, 0.0, 78.3], [0.0, 188.0, 61.7], [0.0, 0.0, 1.0]])


def pose(rotvec=(0.4, -0.7, 0.9), position=(0.01, -0.02, 0.45)) -> np.ndarray:
    """Return camera_from_object with the L's middle at `position` [m]."""
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    out[:3, 3] = np.array(position) - out[:3, :3] @ ((LOW + HIGH) / 2)
    return out


def truth(
    camera_from_object: np.ndarray, camera: np.ndarray = K, height: int = HEIGHT, width: int = WIDTH
) -> np.ndarray:
    """Return the L's z-depth [m], 0 where it is not."""
    v, u = np.mgrid[:height, :width]
    rays = np.stack(
        [(u - camera[0, 2]) / camera[0, 0], (v - camera[1, 2]) / camera[1, 1], np.ones(u.shape)], -1
    )
    inverse = np.linalg.inv(camera_from_object)
    origin, direction = inverse[:3, 3], rays @ inverse[:3, :3].T
    best = np.full(u.shape, np.inf)
    for low, high in BOXES:
        a, b = (np.array(low) - origin) / direction, (np.array(high) - origin) / direction
        near, far = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
        best = np.where((near <= far) & (near > 0), np.minimum(best, near), best)
    return np.where(np.isfinite(best), best, 0.0)


def scene(
    poses: list[np.ndarray], wall: float = 0.9, camera: np.ndarray = K
) -> tuple[np.ndarray, np.ndarray]:
    """Return depth [m] and which pose is seen (-1: the wall)."""
    depth, index = np.full((HEIGHT, WIDTH), wall), np.full((HEIGHT, WIDTH), -1)
    for k, each in enumerate(poses):
        mine = truth(each, camera)
        near = (mine > 0) & (mine < depth)
        depth[near], index[near] = mine[near], k
    return depth, index


def colors(seed: int = 0) -> np.ndarray:
    """Return a smooth picture that differs with the seed.  (H, W, 3) uint8 RGB."""
    small = np.random.default_rng(seed).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    return cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR)


def write_mesh(folder: Path, name: str) -> Path:
    """Write the L as <folder>/<name>/google_16k/textured.obj; return the folder of meshes."""
    path = folder / name / "google_16k" / "textured.obj"
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = []
    for low, high in BOXES:
        lines += [
            f"v {x} {y} {z}"
            for x in (low[0], high[0])
            for y in (low[1], high[1])
            for z in (low[2], high[2])
        ]
    quads = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    for start in (0, 8):
        lines += ["f " + " ".join(str(start + i) for i in quad) for quad in quads]
    path.write_text("\n".join(lines) + "\n")
    return folder


def write_png(path: Path, image: np.ndarray) -> None:
    """Write a picture (RGB where it has color)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    data = image[..., [2, 1, 0, 3][: image.shape[2]]] if image.ndim == 3 else image
    assert cv2.imwrite(str(path), data)


def depth_png(path: Path, depth: np.ndarray, units: float = 10_000.0) -> None:
    """Write depth [m] as 16 bits."""
    write_png(path, np.round(depth * units).astype(np.uint16))


# --- FAT ---
TURN = Rotation.from_euler("zyx", [90, 35, -20], degrees=True).as_matrix()  # aligned_from_mesh
ALIGNED = np.eye(4)
ALIGNED[:3, :3], ALIGNED[:3, 3] = TURN, -TURN @ ((LOW + HIGH) / 2)


def fat_folder(folder: Path, ids: dict[str, int], aligned: np.ndarray = ALIGNED) -> Path:
    """Write a scene's settings."""
    folder.mkdir(parents=True, exist_ok=True)
    F = aligned.T.copy()
    F[:, :3] *= 100
    corners = np.array([[*low, *high] for low, high in BOXES]).reshape(-1, 3)
    points = np.array(
        [[x, y, z] for x in corners[:, 0] for y in corners[:, 1] for z in corners[:, 2]]
    )
    size = np.ptp(points @ aligned[:3, :3].T, axis=0) * 100 if aligned is not ALIGNED else None
    objects = [
        {"class": f"{name}_16k", "segmentation_class_id": i, "fixed_model_transform": F.tolist()}
        for name, i in ids.items()
    ]
    for one in objects:
        if size is not None:
            one["cuboid_dimensions"] = size.tolist()
    inner = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "s": 0}
    cameras = [
        {
            "name": eye,
            "intrinsic_settings": inner,
            "captured_image_size": {"width": WIDTH, "height": HEIGHT},
        }
        for eye in ("left", "right")
    ]
    (folder / "_object_settings.json").write_text(json.dumps({"exported_objects": objects}))
    (folder / "_camera_settings.json").write_text(json.dumps({"camera_settings": cameras}))
    return folder


def fat_frame(
    folder: Path,
    number: int,
    objects: list[tuple[str, int, np.ndarray]],
    eye: str = "left",
    ending: str = "jpg",
) -> None:
    """Write one camera's frame: objects as (class, segment id, camera_from_object of the left
    eye).
    """
    shift = np.eye(4)
    shift[0, 3] = -0.06 if eye == "right" else 0.0
    poses = [shift @ p for _, _, p in objects]
    depth, index = scene(poses)
    ids = np.array([*(i for _, i, _ in objects), 0], np.uint8)
    records = []
    for (name, _, _), p in zip(objects, poses, strict=True):
        q = p @ np.linalg.inv(ALIGNED)
        quat = Rotation.from_matrix(q[:3, :3]).as_quat()
        records.append(
            {
                "class": f"{name}_16k",
                "visibility": 0.81,
                "location": (q[:3, 3] * 100).tolist(),
                "quaternion_xyzw": quat.tolist(),
            }
        )
    stem = f"{number:06d}.{eye}"
    write_png(folder / f"{stem}.{ending}", colors(number))
    depth_png(folder / f"{stem}.depth.png", depth)
    write_png(folder / f"{stem}.seg.png", ids[index])
    (folder / f"{stem}.json").write_text(
        json.dumps({"camera_data": {"location_worldframe": [1e3, 2e3, 3e3]}, "objects": records})
    )


def fat_tree(root: Path, scenes: int = 4, frames: int = 3, name: str = "toy") -> Path:
    """Write `mixed` scenes of one object each, seen from other sides."""
    for s in range(scenes):
        folder = fat_folder(root / "mixed" / f"kitchen_{s}", {name: 24})
        for f in range(frames):
            fat_frame(
                folder,
                f,
                [(name, 24, pose((0.3 * s, 0.4 * f, 0.5), (0.01 * f, 0.0, 0.45 + 0.02 * s)))],
            )
    return root


# --- YCB-Video ---
def ycb_frame(
    stem: Path,
    objects: list[tuple[int, np.ndarray]],
    native: np.ndarray,
    syn: bool = False,
    unlabeled: int | None = None,
    **change,
) -> None:
    """Write a frame: objects as (class index, camera_from_object in the mesh's frame);
    native_from_mesh (4, 4).
    """
    depth, index = scene([p for _, p in objects], camera=change.get("seen_by", K))
    ids = np.array([*(i for i, _ in objects), 0], np.uint8)
    poses = np.stack([(p @ np.linalg.inv(native))[:3] for _, p in objects], axis=-1)
    indices = (
        np.array([i for i, _ in objects], np.float32)[None]
        if syn
        else np.array([i for i, _ in objects], np.uint8)[:, None]
    )
    if unlabeled is not None:
        indices = np.append(indices, [[unlabeled]], axis=1 if syn else 0)
        poses = np.append(poses, poses[..., -1:], axis=-1)
    rgb = colors(int(stem.name))
    color = np.dstack([rgb, np.full((HEIGHT, WIDTH), 7, np.uint8)]) if syn else rgb
    write_png(stem.with_name(f"{stem.name}-color.png"), color)
    depth_png(stem.with_name(f"{stem.name}-depth.png"), depth, change.get("units", 10_000.0))
    write_png(stem.with_name(f"{stem.name}-label.png"), ids[index])
    meta = {
        "cls_indexes": indices,
        "poses": change.get("poses", lambda p: p)(poses),
        "intrinsic_matrix": change.get("K", K),
    }
    meta["factor_depth"] = np.array([[change.get("factor_depth", 10_000.0)]])
    scipy.io.savemat(
        stem.with_name(f"{stem.name}-meta.mat"),
        {k: v for k, v in meta.items() if k != change.get("without")},
    )


# --- BOP ---
def bop_scene(
    folder: Path, frames: list[list[tuple[int, np.ndarray]]], depth_scale: float = 0.25
) -> None:
    """Write a scene: a frame's objects as (obj_id, camera_from_object in BOP's frame)."""
    truth_json, cameras = {}, {}
    for f, objects in enumerate(frames):
        depth, index = scene([p for _, p in objects])
        write_png(folder / "rgb" / f"{f:06d}.png", colors(f))
        depth_png(folder / "depth" / f"{f:06d}.png", depth, 1000.0 / depth_scale)
        for k in range(len(objects)):
            write_png(
                folder / "mask_visib" / f"{f:06d}_{k:06d}.png", (index == k).astype(np.uint8) * 255
            )
        truth_json[str(f)] = [
            {
                "cam_R_m2c": p[:3, :3].ravel().tolist(),
                "cam_t_m2c": (p[:3, 3] * 1000).tolist(),
                "obj_id": i,
            }
            for i, p in objects
        ]
        cameras[str(f)] = {"cam_K": K.ravel().tolist(), "depth_scale": depth_scale}
    (folder / "scene_gt.json").write_text(json.dumps(truth_json))
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
