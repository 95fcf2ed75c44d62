"""Read the Falling Things format: `single` and `mixed`, both cameras, any class; also what
`generate.py` writes.

The chain of a pose: mesh -> F (row vectors, meters to centimeters) -> aligned frame -> quaternion,
location (cm) -> camera.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from posefilter.data.frames import FrameRecord, NotShown, Sample
from posefilter.data.readers.base import BaseReader
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
)
from posefilter.data.readers.fat_settings import (
    FRAME,
    FatCamera,
    FatClass,
    camera_from_aligned,
    camera_settings,
    mesh_name,
    number_scenes,
    object_settings,
    scene_folders,
)
from posefilter.data.readers.naming import choose_objects, choose_several
from posefilter.data.readers.plausible import check_camera
from posefilter.errors import BadData, UserError
from posefilter.geometry.rigid import move
from posefilter.limits import read_json
from posefilter.meshes import ycb
from posefilter.meshes.store import MeshStore
from posefilter.paths import check_inside

DEPTH_UNITS = 10_000.0  # depth image units a meter
# [m]; the wood block's public mesh is off by more, all others by less than 1 mm
_CUBOID_TOLERANCE = 0.005
_LARGEST_ID = 255  # of a segment
_CLEARLY_VISIBLE = 0.2  # FAT's own visibility from which an empty mask contradicts the record


@dataclass(frozen=True, eq=False)
class _Entry:
    """One record, and what reading it takes."""

    record: FrameRecord
    kind: FatClass
    camera: FatCamera
    camera_from_object: np.ndarray  # (4, 4) [m], mesh frame
    visibility: float  # as FAT states it: not a share of pixels
    # poses of every instance of the class in the image, this one's among them
    twins: tuple[np.ndarray, ...]
    twin: int  # which of them


class FatReader(BaseReader):
    """A folder in the FAT format: the whole dataset, `single`, `mixed`, or one scene's folder."""

    def __init__(
        self,
        root: str | Path,
        objects: str | Sequence[str] | None = None,
        meshes: MeshStore | None = None,
        cameras: Sequence[str] = ("left", "right"),
        subsets: Sequence[str] = ("single", "mixed"),
        on_error: str = "raise",
    ) -> None:
        """List the frames.

        Args:
            root: The dataset's folder.
            objects: Classes, with or without FAT's `_16k`; None: all.
            meshes: For visibility, and to tell two instances of a class apart; without, frames
                with two are left out.
            cameras: "left", "right" or both.
            subsets: "single", "mixed" or both.
            on_error: "raise", or "skip" broken frames and count them.

        Raises:
            UserError: There are no frames, or no such class.
        """
        super().__init__(root, meshes, on_error)
        self.cameras = choose_several("cameras", cameras, ("left", "right"))
        subsets = choose_several("subsets", subsets, ("single", "mixed"))
        self._native: dict[str, np.ndarray] = {}
        # a folder whose frame of the class is not the first folder's
        self._ambiguous: dict[str, Path] = {}
        folders = sorted(scene_folders(self.root, set(subsets)))
        if not folders:
            raise UserError(
                f"{self.root}: no FAT scenes here: no folder with "
                f"_object_settings.json and NNNNNN.left.json"
            )
        settings = [(folder, self._settings(folder)) for folder in folders]
        known = sorted({name for _, one in settings if one for name in one[0]})
        self.objects = choose_objects(
            objects,
            known,
            self.root,
            strip=lambda name: name if name in known else name.removesuffix("_16k"),
            broken=next(iter(self.examples.values()), ""),
        )
        self._entries: list[_Entry] = []
        numbers_of_scenes = number_scenes(self.root, folders)
        for number, (folder, one) in zip(numbers_of_scenes, settings, strict=True):
            if one is not None:
                self._entries += self._list_folder(number, folder, *one)
        if objects is None:
            self._drop_absent()

    def native_from_mesh(self, name: str) -> np.ndarray:
        """Return FAT's aligned frame from the mesh file's.  -> (4, 4) [m]."""
        if name not in self._native:
            raise UserError(f"{self.root}: no object settings of class '{name}'")
        if name in self._ambiguous:
            path = self._ambiguous[name] / "_object_settings.json"
            raise UserError(
                f"{path}: another fixed_model_transform of '{name}' than in other folders"
            )
        return self._native[name].copy()

    def read(self, i: int) -> Sample:
        """Return record i at the dataset's resolution, its visibility still unknown.

        Raises BadData.
        """
        entry = self._entries[i]
        record, camera = entry.record, entry.camera
        color_path, depth_path, seg_path, json_path, camera_path, _ = self._files(record)
        check_camera(camera.K, camera_path)
        rgb = read_color(color_path)
        depth = read_depth(depth_path, DEPTH_UNITS)
        seg = read_label(seg_path)
        for path, image in zip(record.files, (rgb, depth, seg), strict=False):
            expect_size(path, image, camera.height, camera.width, "_camera_settings.json")
        if int(seg.max()) > _LARGEST_ID:
            raise BadData(seg_path, "no segment image", f"id {int(seg.max())}; is it the depth?")
        mask = self._mask(entry, seg)
        files = (camera_path, json_path, depth_path, seg_path)
        aligned = entry.kind.aligned_from_mesh
        return self._make_sample(i, rgb, depth, mask, camera.K, aligned, files)

    def _mask(self, entry: _Entry, seg: np.ndarray) -> np.ndarray:
        if not self._is_shown(entry):
            return np.zeros_like(seg, dtype=bool)
        mask = self._own_part(entry, entry.camera.K, seg == entry.kind.seg_id)
        if mask.any():
            return mask
        path = entry.record.files[2]
        detail = f"no pixel of {entry.record.object}, id {entry.kind.seg_id}"
        clear = entry.visibility >= _CLEARLY_VISIBLE and len(entry.twins) == 1
        if clear and _center_in_frame(entry):
            detail += f", though its JSON says visibility {entry.visibility:.2f}"
            raise BadData(path, "empty mask", detail)
        raise NotShown(path, "listed, but not in the label", detail)

    def _settings(self, folder: Path) -> tuple[dict[str, FatClass], dict[str, FatCamera]] | None:
        """Return a folder's classes and cameras, None where they are broken and on_error is
        "skip".
        """
        try:
            objects, cameras = (
                check_inside(folder / f"_{kind}_settings.json", self.root)
                for kind in ("object", "camera")
            )
            return object_settings(objects), camera_settings(cameras)
        except BadData as error:
            self._leave_out(error, max(1, count_pictures(folder)))
            return None

    def _list_folder(
        self, number: int, folder: Path, classes: dict[str, FatClass], known: dict[str, FatCamera]
    ) -> Iterator[_Entry]:
        for name in self.objects:
            if name in classes:
                self._remember(name, classes[name], folder)
        names = set(list_folder(folder))
        for stem in sorted({found[1] for found in map(FRAME.match, names) if found}):
            frame, camera = stem.split(".")
            if camera not in self.cameras:
                continue
            try:
                if camera not in known:
                    raise BadData(folder / "_camera_settings.json", f"no camera named '{camera}'")
                only_png = f"{stem}.jpg" not in names and f"{stem}.png" in names
                endings = ("png" if only_png else "jpg", "depth.png", "seg.png", "json")
                own = (f"{stem}.{ending}" for ending in endings)
                shared = ("_camera_settings.json", "_object_settings.json")
                files = tuple(folder / x for x in (*own, *shared))
                scene = 2 * number + (camera == "right")
                yield from self._list_frame(scene, int(frame), files, classes, known[camera])
            except BadData as error:
                self._leave_out(error)

    def _list_frame(
        self,
        scene_id: int,
        im_id: int,
        files: tuple[Path, ...],
        classes: dict[str, FatClass],
        camera: FatCamera,
    ) -> list[_Entry]:
        path = files[3]
        content = read_json(check_inside(path, self.root))
        found: dict[str, list[tuple[int, np.ndarray, float]]] = {}
        for k, one in enumerate(need_list(content, "objects", path)):
            where = f"objects[{k}]."
            name = mesh_name(need(one, "class", path, where), path)
            if name not in classes:
                raise BadData(
                    path, "unknown class", f"'{name}' is not in the folder's _object_settings.json"
                )
            if name in self.objects:
                pose = camera_from_aligned(one, path, where) @ classes[name].aligned_from_mesh
                told = "visibility" in one
                visibility = float(numbers(one, "visibility", path, (), where)) if told else 1.0
                found.setdefault(name, []).append((k, pose, visibility))
        entries = []
        # kitchen_0 is one place, whether in `single` or in `mixed`, left or right
        group = path.parent.name
        scene = group if path.parent == self.root else path.parent.relative_to(self.root).as_posix()
        image = f"{scene}/{path.name.removesuffix('.json')}"
        for name, many in found.items():
            if len(many) > 1 and (self._geometry is None or self._geometry.mesh(name) is None):
                why = "two instances of one class, and no mesh that fits to tell them apart"
                self.skipped[why] += len(many)
                self.unlisted.add((image, name))
                continue
            if len(many) > 1:
                self.notes["masks split between instances of one class by geometry"] += len(many)
            twins = tuple(pose for _, pose, _ in many)
            listed = name in ycb.CLASSES
            number = ycb.ycbvideo_index(name) if listed else classes[name].seg_id
            for twin, (k, pose, visibility) in enumerate(many):
                record = FrameRecord(image, group, scene_id, im_id, number, name, k, files)
                entries.append(_Entry(record, classes[name], camera, pose, visibility, twins, twin))
        return entries

    def _remember(self, name: str, kind: FatClass, folder: Path) -> None:
        """Keep a class's frame, and see whether the mesh is the one that the cuboid was measured
        on.
        """
        known = self._native.setdefault(name, kind.aligned_from_mesh)
        if not np.allclose(known, kind.aligned_from_mesh, atol=1e-4):
            self._ambiguous.setdefault(name, folder)
        mesh = None if self._geometry is None else self._geometry.mesh(name)
        if mesh is None or kind.dimensions is None or self._geometry is None:
            return
        aligned = move(mesh.vertices, kind.aligned_from_mesh)
        low, high = aligned.min(0), aligned.max(0)
        off = max(np.abs(high - low - kind.dimensions).max(), np.abs(high + low).max() / 2)
        if off > _CUBOID_TOLERANCE:
            self._geometry.without.add(name)
            self.notes[
                f"mesh of {name} is not the one that FAT measured ({off * 1000:.0f} mm "
                f"off): no visibility"
            ] = 1


def _center_in_frame(entry: _Entry) -> bool:
    x, y, z = entry.camera_from_object[:3] @ np.linalg.inv(entry.kind.aligned_from_mesh)[:, 3]
    if z <= 0:
        return False
    u, v, _ = entry.camera.K @ [x / z, y / z, 1]
    return bool(0 <= u < entry.camera.width and 0 <= v < entry.camera.height)
