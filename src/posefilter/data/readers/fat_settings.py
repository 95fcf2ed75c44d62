"""Parse the JSON files of the Falling Things format."""

import math
import re
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from posefilter.data.readers.decode import list_folder, need, need_list, numbers, whole_number
from posefilter.errors import BadData, UserError
from posefilter.geometry.pose import is_rigid
from posefilter.geometry.rigid import rigid
from posefilter.geometry.rotation import matrix_from_quat_xyzw
from posefilter.limits import MOST_SIDE, read_json
from posefilter.paths import is_plain_name

CM = 0.01  # meters a centimeter
FRAME = re.compile(r"^(\d+\.(?:left|right))\.(?:json|jpg|png)$")
SUBSETS = frozenset({"single", "mixed"})  # folders of the dataset
_DEEPEST = 6  # folders between the dataset's and a scene's
_NEWER = re.compile(r"\.(cs|is|depth\.16|depth\.cm\.\d+)\.png$")


@dataclass(frozen=True, eq=False)
class FatClass:
    """A class, as a folder's settings have it."""

    seg_id: int
    aligned_from_mesh: np.ndarray  # (4, 4) rigid [m]
    dimensions: np.ndarray | None  # (3,) of the cuboid [m]


@dataclass(frozen=True, eq=False)
class FatCamera:
    """A camera, as a folder's settings have it."""

    K: np.ndarray  # (3, 3)
    height: int
    width: int


def scene_folders(root: Path, subsets: Set[str], deep: int = 0) -> Iterator[Path]:
    """Yield the folders that hold frames, not looking below them."""
    if not root.is_dir():
        raise UserError(f"{root}: no such folder (data.root)")
    if deep > _DEEPEST:
        raise UserError(f"{root}: folders nested more than {_DEEPEST} deep; a link to itself?")
    names = list_folder(root)
    if _is_scene(names):
        yield root
        return
    if any(_NEWER.search(name) for name in names):
        raise UserError(
            f"{root}: these names (.cs.png, .depth.16.png) are a newer export's; FAT "
            f"has .seg.png, .depth.png"
        )
    for name in names:
        unwanted = name.startswith(".") or name in SUBSETS - subsets
        if not unwanted and (root / name).is_dir():
            yield from scene_folders(root / name, subsets, deep + 1)


def number_scenes(root: Path, folders: Sequence[Path]) -> list[int]:
    """Return the number of each folder of frames: its place among all scenes of its dataset, so
    that it stays the same whichever part of the dataset is read.

    Args:
        root: The dataset's folder, or one in it: a subset, an object of `single`, a scene.
        folders: Folders of frames in the root.
    """
    every = sorted(scene_folders(root, SUBSETS))
    real = root.resolve()
    above = next((one for one in (real, *real.parents[:2]) if one.name in SUBSETS), None)
    if above is not None and SUBSETS.isdisjoint(list_folder(root)):
        top = above.parent
        layout = [*top.glob("mixed/*/"), *top.glob("single/*/*/")]
        whole = sorted(one for one in layout if one.is_dir() and _is_scene(list_folder(one)))
        if {real / one.relative_to(root) for one in every} <= set(whole):
            return [whole.index(real / one.relative_to(root)) for one in folders]
    return [every.index(one) for one in folders]


def _is_scene(names: Sequence[str]) -> bool:
    """Tell whether these are the names in a folder of frames."""
    return "_object_settings.json" in names or any(map(FRAME.match, names))


def mesh_name(fat_class: Any, path: Path) -> str:
    """Return the name of a class's mesh.  Raises BadData where it is no plain name."""
    name = str(fat_class).removesuffix("_16k")
    if not is_plain_name(name):
        raise BadData(path, "class with an impossible name", repr(name[:40]))
    return name


def object_settings(path: Path) -> dict[str, FatClass]:
    """Return the classes of a folder's `_object_settings.json`, by mesh name."""
    classes = {}
    for k, one in enumerate(need_list(read_json(path), "exported_objects", path)):
        where = f"exported_objects[{k}]."
        F = numbers(one, "fixed_model_transform", path, (4, 4), where)
        aligned = F.T.copy()  # row vectors -> columns
        aligned[:3] *= CM  # x100 in the rotation, centimeters in the translation
        if not is_rigid(torch.from_numpy(aligned), tolerance=2e-3):
            wrong = "is not 100 x a rotation with its shift in the last row"
            raise BadData(path, f"'{where}fixed_model_transform' {wrong}")
        sized = "cuboid_dimensions" in one
        size = numbers(one, "cuboid_dimensions", path, (3,), where) * CM if sized else None
        seg_id = whole_number(one, "segmentation_class_id", path, where)
        classes[mesh_name(need(one, "class", path, where), path)] = FatClass(seg_id, aligned, size)
    return classes


def camera_settings(path: Path) -> dict[str, FatCamera]:
    """Return the cameras of a folder's `_camera_settings.json`, by name."""
    cameras = {}
    for k, one in enumerate(need_list(read_json(path), "camera_settings", path)):
        where = f"camera_settings[{k}]."
        inner, inside = need(one, "intrinsic_settings", path, where), f"{where}intrinsic_settings."
        fx, fy, cx, cy = (
            float(numbers(inner, key, path, (), inside)) for key in ("fx", "fy", "cx", "cy")
        )
        size = need(one, "captured_image_size", path, where)
        width, height = (
            whole_number(size, key, path, f"{where}captured_image_size.")
            for key in ("width", "height")
        )
        skew = float(numbers(inner, "s", path, (), inside)) if "s" in inner else 0.0
        if not (0 < width <= MOST_SIDE and 0 < height <= MOST_SIDE):
            found = f"{where}captured_image_size {width}x{height}"
            raise BadData(path, "no such image size", found)
        K = np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        cameras[str(need(one, "name", path, where))] = FatCamera(K, height, width)
    return cameras


def camera_from_aligned(record: Any, path: Path, where: str) -> np.ndarray:
    """Return an object's pose in FAT's aligned frame.  -> (4, 4) [m]."""
    quat = numbers(record, "quaternion_xyzw", path, (4,), where)
    norm = math.hypot(*quat)  # of huge numbers infinite, where a sum of squares would warn
    if abs(norm - 1) > 0.01:  # four decimals leave it 1e-4 off
        wrong = f"'{where}quaternion_xyzw' is not a unit quaternion"
        raise BadData(path, wrong, f"norm {norm:.3g}")
    rotation = matrix_from_quat_xyzw(torch.from_numpy(quat / norm)).numpy()
    return rigid(rotation, numbers(record, "location", path, (3,), where) * CM)
