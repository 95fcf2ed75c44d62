"""Read datasets in BOP's format: millimeters, objects by number, one mask an instance."""

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from posefilter.data.frames import FrameRecord, NotShown, Sample
from posefilter.data.readers.base import AHEAD, BaseReader
from posefilter.data.readers.decode import (
    count_pictures,
    expect_size,
    list_folder,
    need,
    need_list,
    numbers,
    read_color,
    read_depth,
    read_label,
    whole_number,
)
from posefilter.data.readers.naming import choose_objects, need_text
from posefilter.data.readers.plausible import check_camera, check_units
from posefilter.errors import BadData, UserError
from posefilter.geometry.pose import is_rigid
from posefilter.geometry.rigid import rigid
from posefilter.limits import read_json
from posefilter.meshes import ycb
from posefilter.meshes.store import MeshStore
from posefilter.paths import check_inside

MM = 0.001  # meters a millimeter
_ENDINGS = ("png", "jpg", "tif", "jpeg", "tiff", "PNG", "JPG", "TIF", "JPEG", "TIFF")
_DEPTH_ENDINGS = ("png", "tif", "tiff", "PNG", "TIF", "TIFF")  # ITODD's images are TIFF
_INFO = "models_info.json"
_SAME_DIAMETER = 0.05  # share by which BOP's models of YCB-V may differ from YCB's own
_IMAGE = _SCENE = re.compile(r"[0-9]{1,9}")


@dataclass(frozen=True, eq=False)
class _Entry:
    """One record, and what reading it takes."""

    record: FrameRecord
    K: np.ndarray  # (3, 3)
    units: float  # depth image units a meter
    camera_from_object: np.ndarray  # (4, 4) [m], mesh frame
    siblings: tuple[Path, ...]  # masks of the image's other instances


class BopReader(BaseReader):
    """A split's folder of a BOP dataset (`test`, `train_pbr`, ...), or the dataset's with `split`
    naming the split.
    """

    def __init__(
        self,
        root: str | Path,
        objects: str | Sequence[str] | None = None,
        meshes: MeshStore | None = None,
        split: str | None = None,
        mesh_frame: str | None = None,
        inverted: bool = False,
        on_error: str = "raise",
    ) -> None:
        """List the frames.

        Args:
            root: The folder of a split, or of the dataset.
            objects: `obj_000002` as the models are named, or YCB's names for YCB-V; None: all, by
                YCB's names where `mesh_frame` is "original".
            meshes: For visibility.
            split: BOP's split, where `root` is the dataset's folder.
            mesh_frame: "bop" where meshes are the dataset's own (the default for obj_...; the mesh
                store wants scale=0.001), "original" where they are google_16k (the default for
                YCB's names).
            inverted: `cam_R_m2c` and `cam_t_m2c` hold the camera's pose in the object's frame, and
                not the object's in the camera's, as datasets of BOP's layout exist that do.
            on_error: "raise", or "skip" broken frames and count them.

        Raises:
            UserError: There are no scenes, no such class, or a file is broken.
        """
        super().__init__(root, meshes, on_error)
        if not isinstance(inverted, bool):
            raise UserError(f"data.options.inverted={inverted}: choose true or false")
        need_text("split", split)
        self._inverted = inverted
        base = self.root / split if split else self.root
        missing = self.root.is_dir() and not base.is_dir()
        folders = [] if missing else sorted(_scene_folders(base))
        if not folders:
            home = self.root if missing else base
            splits = sorted({path.parts[-3] for path in home.glob("*/*/scene_gt.json")})
            why = "no such folder" if missing else "no BOP scenes here: no <scene>/scene_gt.json"
            raise UserError(
                f"{base}: {why} (data.root, data.options.split={'|'.join(splits) or '...'})"
            )
        if not any((folder / "scene_gt.json").exists() for folder in folders):
            several = sorted(folders[0].glob("scene_gt_*.json"))
            why = "is the ground truth of this split public? (data.options.split)"
            if several:  # IPD's, XYZ-IBD's, ITODD-MV's
                own = ", ".join(path.stem.removeprefix("scene_gt_") for path in several)
                why = f"it has several cameras ({own}), of which none is read; link the files of "
                why += "one under the plain names (scene_gt.json, rgb, ...)"
            raise UserError(
                f"{folders[0]}: has no scene_gt.json, nor has any other scene of {base}: {why}"
            )
        scenes = [(folder, self._read_scene(folder)) for folder in folders]
        wanted = [objects] if isinstance(objects, str) else objects
        self._by_ycb_name = (
            mesh_frame == "original"
            if wanted is None
            else bool(wanted) and all(str(name) in ycb.CLASSES for name in wanted)
        )
        self._mesh_frame = mesh_frame or ("original" if self._by_ycb_name else "bop")
        if self._mesh_frame not in ("bop", "original"):
            raise UserError(f"data.options.mesh_frame={mesh_frame}: choose bop or original")
        numbers_seen = {
            int(one["obj_id"]) for _, scene in scenes for gt in scene[0].values() for one in gt
        }
        known = sorted(map(self._name, numbers_seen))
        broken = next(iter(self.examples.values()), "")
        try:
            self.objects = choose_objects(wanted, known, base, broken=broken)
        except UserError as error:
            if not (self._by_ycb_name and known):
                raise
            own = ", ".join(f"obj_{n:06d}" for n in sorted(numbers_seen))
            raise UserError(
                f"{base}: its scenes have no '{', '.join(map(str, wanted or []))}' (data.object), "
                f"YCB-V's name of a number; they have {own}; data.object=null takes all"
                + (f"; left out: {broken}" if broken else "")
            ) from error
        if wanted is None and self._mesh_frame == "original":  # of others the frame is not known
            related = {*ycb.CLASSES} - ycb.WITHOUT_GEOMETRY
            self.objects = tuple(name for name in self.objects if name in related)
        self._distrust_builtin()
        self._native = {name: self.native_from_mesh(name) for name in self.objects}
        self._empty: list[_Entry] = []
        self._entries = [
            entry for folder, scene in scenes for entry in self._list_scene(base, folder, *scene)
        ]

    def native_from_mesh(self, name: str) -> np.ndarray:
        """Return BOP's object frame from the mesh file's.  -> (4, 4) [m], not millimeters."""
        if self._mesh_frame != "original":
            return np.eye(4)
        try:
            return ycb.bop_from_original(name)
        except KeyError as error:
            raise UserError(
                f"{name}: no relation between a google_16k mesh and BOP's frame is known; use "
                "BOP's models"
            ) from error

    def check_diameter(self, name: str, diameter: float) -> None:
        """Raise UserError where a dataset that is not YCB-V has another object by the number that
        one of YCB's has there, as the diameter in its `models_info.json` tells.
        """
        if self._mesh_frame != "original" or name not in ycb.CLASSES:
            return
        roots = [self.root / "models", self.root.parent / "models"]
        if self._geometry is not None:
            roots.insert(0, Path(str(self._geometry.meshes.root)))
        file = next((root / _INFO for root in roots if (root / _INFO).is_file()), None)
        number = ycb.ycbvideo_index(name)
        content = None if file is None else read_json(file)
        entry = content.get(str(number)) if isinstance(content, dict) else None
        if file is None or not (isinstance(entry, dict) and "diameter" in entry):
            return  # nothing to compare
        theirs = MM * float(numbers(entry, "diameter", file, (), f"{number}."))
        if abs(theirs - diameter) > _SAME_DIAMETER * diameter:
            raise UserError(
                f"{file}: object {number} has a diameter of {1000 * theirs:.0f} mm, and {name}, "
                f"which has this number in YCB-V, {1000 * diameter:.0f} mm: the dataset has no "
                f"{name} by it"
            )

    def read(self, i: int) -> Sample:
        """Return record i at the dataset's resolution, its visibility still unknown.

        Raises BadData.
        """
        entry = self._entries[i]
        color_path, depth_path, mask_path, gt_path, camera_path = self._files(entry.record)
        check_camera(entry.K, camera_path)
        mask = self._read_mask(mask_path) if self._is_shown(entry) else None
        rgb = read_color(color_path)
        depth = read_depth(depth_path, entry.units, scaled_floats=True)
        height, width = rgb.shape[:2]
        expect_size(depth_path, depth, height, width, color_path.name)
        files = (camera_path, gt_path, depth_path, mask_path)
        if mask is None:
            nothing = np.zeros((height, width), dtype=bool)
            return self._make_sample(i, rgb, depth, nothing, entry.K, np.eye(4), files)
        expect_size(mask_path, mask, height, width, color_path.name)
        if not mask.any():
            raise NotShown(mask_path, "listed, but not in the label", entry.record.object)
        native = self._native[entry.record.object]
        return self._make_sample(i, rgb, depth, mask, entry.K, native, files)

    @staticmethod
    def _read_mask(path: Path) -> np.ndarray:
        if not path.is_file():
            advice = "bop_toolkit's scripts/calc_gt_masks.py writes the masks"
            raise BadData(path, "missing file", advice)
        label = read_label(path)
        if ((label != 0) & (label != label.max())).any():
            raise BadData(path, "no mask", "more than two values; is it the depth?")
        return label > 0

    def others(self, i: int) -> np.ndarray:
        """Return the pixels of any other labeled object.  -> (H, W) bool."""
        entry = self._entries[i]
        mask = read_label(self._files(entry.record)[2]) > 0
        out = np.zeros_like(mask)
        for path in entry.siblings:
            out |= read_label(check_inside(path, self.root)) > 0
        return out & ~mask

    def _name(self, number: int) -> str:
        known = self._by_ycb_name and 1 <= number <= len(ycb.CLASSES)
        return ycb.CLASSES[number - 1] if known else f"obj_{number:06d}"

    def _read_scene(self, folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return a scene's truth and cameras by image, without the images whose records are broken
        where on_error is "skip".
        """
        images = 1  # that are left out where the scene's files are broken
        try:
            images = max(1, count_pictures(folder / "rgb"), count_pictures(folder / "gray"))
            truth, cameras = (
                read_json(check_inside(folder / f"scene_{kind}.json", self.root))
                for kind in ("gt", "camera")
            )
            for name, content in (("gt", truth), ("camera", cameras)):
                if not (isinstance(content, dict) and all(map(_IMAGE.fullmatch, content))):
                    raise BadData(
                        folder / f"scene_{name}.json", "not records by the number of the image"
                    )
        except BadData as error:
            self._leave_out(error, images)
            return {}, {}
        path, whole = folder / "scene_gt.json", dict[str, Any]()
        for image in truth:
            try:
                for k, one in enumerate(need_list(truth, image, path)):
                    whole_number(one, "obj_id", path, f"{image}[{k}].")
                whole[image] = truth[image]
            except BadData as error:
                self._leave_out(error)
        return whole, {str(int(image)): camera for image, camera in cameras.items()}

    def _list_scene(
        self, base: Path, folder: Path, truth: dict[str, Any], cameras: dict[str, Any]
    ) -> Iterator[_Entry]:
        group = folder.name if folder != base else base.name
        for image in sorted(truth, key=int):
            try:
                yield from self._list_frame(folder, group, image, truth[image], cameras)
            except BadData as error:
                self._leave_out(error)

    def _list_frame(
        self,
        folder: Path,
        group: str,
        image: str,
        truth: list[dict[str, Any]],
        cameras: dict[str, Any],
    ) -> list[_Entry]:
        gt_path, camera_path = folder / "scene_gt.json", folder / "scene_camera.json"
        stem = f"{int(image):06d}"
        camera = need(cameras, str(int(image)), camera_path)  # either may be written as 000003
        K = numbers(camera, "cam_K", camera_path, (3, 3), f"{image}.")
        scale = float(numbers(camera, "depth_scale", camera_path, (), f"{image}."))
        units = 1 / (scale * MM) if scale > 0 else scale
        check_units(units, camera_path, f"{image}.depth_scale")
        masks = [folder / "mask_visib" / f"{stem}_{k:06d}.png" for k in range(len(truth))]
        subs = ("rgb", "gray")  # where a sensor has no color
        color = _first(folder / sub / f"{stem}.{end}" for sub in subs for end in _ENDINGS)
        depth = _first(folder / "depth" / f"{stem}.{end}" for end in _DEPTH_ENDINGS)
        if not truth:
            files = (color, depth, gt_path, gt_path, camera_path)  # there is no mask
            record = FrameRecord(
                f"{group}/{stem}", group, int(folder.name), int(image), 0, "", 0, files
            )
            self._empty.append(_Entry(record, K, units, AHEAD, ()))
        entries = []
        for k, one in enumerate(truth):
            where = f"{image}[{k}]."
            number = whole_number(one, "obj_id", gt_path, where)
            name = self._name(number)
            if name not in self.objects:
                continue
            rotation = numbers(one, "cam_R_m2c", gt_path, (3, 3), where)
            pose = rigid(rotation, numbers(one, "cam_t_m2c", gt_path, (3,), where) * MM)
            if not is_rigid(torch.from_numpy(pose), tolerance=2e-3):
                raise BadData(gt_path, f"'{where}cam_R_m2c' is no rotation")
            camera_from_object = np.linalg.inv(pose) if self._inverted else pose
            files = (color, depth, masks[k], gt_path, camera_path)
            record = FrameRecord(
                f"{group}/{stem}", group, int(folder.name), int(image), number, name, k, files
            )
            siblings = tuple(mask for j, mask in enumerate(masks) if j != k)
            pose = camera_from_object @ self._native[name]
            entries.append(_Entry(record, K, units, pose, siblings))
        return entries


def _first(candidates: Iterable[Path]) -> Path:
    """Return the first path that is there; the first of all where none is."""
    listed = [*candidates]
    return next((path for path in listed if path.is_file()), listed[0])


def _scene_folders(base: Path) -> Iterator[Path]:
    if not base.is_dir():
        raise UserError(f"{base}: no such folder (data.root)")
    if _SCENE.fullmatch(base.name) and (base / "scene_camera.json").is_file():
        yield base
        return
    for name in list_folder(base):
        if _SCENE.fullmatch(name) and (base / name).is_dir():
            yield base / name
        elif _is_file(base / name / "scene_gt.json"):
            raise UserError(
                f"{base / name}: scenes are named by numbers, such as 000001; rename it, or move "
                "it out of the dataset"
            )


def _is_file(path: Path) -> bool:
    with suppress(OSError):  # its folder may not be read, and need not
        return path.is_file()
    return False
