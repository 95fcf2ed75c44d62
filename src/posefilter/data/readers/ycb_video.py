"""Read YCB-Video as it was published: `data/<scene>/NNNNNN-{color,depth,label}.png` and
`-meta.mat`, and `data_syn`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from posefilter.data.frames import FrameRecord, NotShown, Sample
from posefilter.data.readers.base import BaseReader
from posefilter.data.readers.decode import expect_size, numbers, read_color, read_depth, read_label
from posefilter.data.readers.naming import choose_objects, choose_several, need_text
from posefilter.data.readers.plausible import check_camera, check_units
from posefilter.data.readers.ycb_video_files import (
    FRAME,
    SYNTHETIC,
    list_scenes,
    list_stems,
    read_class_names,
    read_frame_list,
    read_meta,
)
from posefilter.errors import BadData, UserError
from posefilter.geometry.pose import is_rigid
from posefilter.geometry.rigid import rigid
from posefilter.meshes import ycb
from posefilter.meshes.store import MeshStore
from posefilter.paths import check_inside

_SYN_SCENE, _SYN_BLOCK = 1000, 100


@dataclass(frozen=True, eq=False)
class _Entry:
    """One record, and what reading it takes."""

    record: FrameRecord
    label: int
    K: np.ndarray  # (3, 3)
    units: float  # depth image units a meter
    camera_from_object: np.ndarray  # (4, 4) [m], mesh frame
    twins: tuple[np.ndarray, ...]  # poses of every instance of the class in the image
    twin: int  # which of them is this one


class YCBVideoReader(BaseReader):
    """YCB-Video's folder, its `data` or `data_syn`, or any other in its layout."""

    def __init__(
        self,
        root: str | Path,
        objects: str | Sequence[str] | None = None,
        meshes: MeshStore | None = None,
        subsets: Sequence[str] = ("data",),
        frames: str | Path | None = None,
        mesh_frame: str = "original",
        on_error: str = "raise",
    ) -> None:
        """List the frames.

        Args:
            root: The dataset's folder, its `data` or `data_syn`, or a scene's.
            objects: Classes; None: all.
            meshes: For visibility, and to tell two instances of a class apart.
            subsets: "data", "data_syn" or both.
            frames: A list such as image_sets/keyframe.txt; nothing else is looked at.
            mesh_frame: "original" where meshes are YCB's google_16k, "ycb_video" where they are
                YCB-Video's own models.
            on_error: "raise", or "skip" broken frames and count them.

        Raises:
            UserError: There are no frames, no such class, or a file is broken.
        """
        super().__init__(root, meshes, on_error)
        if mesh_frame not in ("original", "ycb_video"):
            raise UserError(f"data.options.mesh_frame={mesh_frame}: choose original or ycb_video")
        subsets = choose_several("subsets", subsets, ("data", "data_syn"))
        need_text("frames", frames)
        self._mesh_frame = mesh_frame
        self._classes = read_class_names(self.root)
        usable = [
            c for c in self._classes if mesh_frame == "ycb_video" or c not in ycb.WITHOUT_GEOMETRY
        ]
        self.objects = choose_objects(
            objects, usable if objects is None else self._classes, self.root
        )
        self._native = {name: self.native_from_mesh(name) for name in self.objects}
        self._distrust_builtin()
        self._entries: list[_Entry] = []
        for scene_id, im_id, name, stem in self._frames(set(subsets), frames):
            try:
                self._entries += self._list_frame(scene_id, im_id, name, stem)
            except BadData as error:
                self._leave_out(error)
        if objects is None:
            self._drop_absent()

    def native_from_mesh(self, name: str) -> np.ndarray:
        """Return YCB-Video's object frame from the mesh file's.  -> (4, 4) [m]."""
        if self._mesh_frame == "ycb_video":
            return np.eye(4)
        try:
            return ycb.ycbvideo_from_original(name)
        except KeyError as error:
            hint = "use YCB-Video's own models, and data.options.mesh_frame=ycb_video"
            raise UserError(
                f"{name}: no relation between a google_16k mesh and YCB-Video's frame is known; "
                f"{hint}"
            ) from error

    def read(self, i: int) -> Sample:
        """Return record i at the dataset's resolution, its visibility still unknown.

        Raises BadData.
        """
        entry = self._entries[i]
        color_path, depth_path, label_path, meta_path = self._files(entry.record)
        check_camera(entry.K, meta_path)
        rgb = read_color(color_path)
        depth = read_depth(depth_path, entry.units)
        label = read_label(label_path)
        height, width = rgb.shape[:2]
        expect_size(depth_path, depth, height, width, color_path.name)
        expect_size(label_path, label, height, width, color_path.name)
        files = (meta_path, meta_path, depth_path, label_path)
        mask = self._mask(entry, label)
        native = self._native[entry.record.object]
        return self._make_sample(i, rgb, depth, mask, entry.K, native, files)

    def _mask(self, entry: _Entry, label: np.ndarray) -> np.ndarray:
        path = entry.record.files[2]
        if int(label.max()) > len(self._classes):
            found = f"label {int(label.max())}, but there are {len(self._classes)} classes"
            raise BadData(path, "unknown class", found)
        if not self._is_shown(entry):
            return np.zeros_like(label, dtype=bool)
        mask = self._own_part(entry, entry.K, label == entry.label)
        if not label.any():
            raise BadData(path, "empty mask", "no object at all in the label image")
        if not mask.any():
            raise NotShown(path, "listed, but not in the label", entry.record.object)
        return mask

    def _frames(
        self, subsets: set[str], listed: str | Path | None
    ) -> Iterator[tuple[int, int, str, Path]]:
        """Yield (scene_id, im_id, name, path without its ending) of every frame, in order."""
        if not self.root.is_dir():
            raise UserError(f"{self.root}: no such folder (data.root)")
        folders = dict(list_scenes(self.root, subsets))
        if not folders:
            raise UserError(
                f"{self.root}: no YCB-Video scenes here: no <scene>/NNNNNN-meta.mat "
                f"in data or data_syn"
            )
        if listed is not None:
            names = read_frame_list(self.root, listed)
        else:
            names = [
                f"{scene}/{stem}"
                for scene, folder in sorted(folders.items())
                for stem in sorted(list_stems(folder))
            ]
        missing = unread = 0
        for name in names:
            scene, stem = name.rsplit("/", 1)
            if not FRAME.fullmatch(stem):
                raise UserError(
                    f"{folders.get(scene, self.root)}/{stem}: frames are named by "
                    f"numbers, such as 000001"
                )
            if scene not in folders:
                missing += 1
                unread += scene == SYNTHETIC and (self.root / SYNTHETIC).is_dir()
                continue
            scene_id = (
                _SYN_SCENE + int(stem) // _SYN_BLOCK
                if scene == SYNTHETIC
                else int("".join(c for c in scene if c in "0123456789")[:9] or 0)
            )
            yield scene_id, int(stem), name, folders[scene] / stem
        advice = "data.options.subsets=[data,data_syn] reads those of data_syn"
        if missing == len(names):
            raise UserError(
                f"{listed or self.root}: none of its {missing} frames is in {self.root}"
                + (f"; {advice}" if unread else "")
            )
        if unread:
            self.notes[f"frames of data_syn in {listed} are left out: {advice}"] = unread
        if missing > unread:
            self.notes[f"frames in {listed} whose scenes are not in {self.root}"] = missing - unread

    def _list_frame(self, scene_id: int, im_id: int, name: str, stem: Path) -> list[_Entry]:
        path = stem.with_name(f"{stem.name}-meta.mat")
        meta = read_meta(check_inside(path, self.root))
        indices = numbers(meta, "cls_indexes", path, (np.size(meta["cls_indexes"]),))
        if len(indices) == 0:
            return []
        if not np.isin(indices, np.arange(1, len(self._classes) + 1)).all():
            found = f"cls_indexes {indices.tolist()}, but there are {len(self._classes)} classes"
            raise BadData(path, "unknown class", found)
        classes = [self._classes[int(k) - 1] for k in indices]
        if not set(classes) & set(self.objects):
            return []
        poses = numbers(meta, "poses", path, (3, 4, len(classes))).transpose(2, 0, 1)
        K = numbers(meta, "intrinsic_matrix", path, (3, 3))
        units = float(numbers(meta, "factor_depth", path, ()))
        check_units(units, path, "factor_depth")
        files = tuple(
            stem.with_name(f"{stem.name}-{ending}")
            for ending in ("color.png", "depth.png", "label.png", "meta.mat")
        )
        entries = []
        for k, each in enumerate(classes):
            if each not in self.objects:
                continue
            same = [j for j, other in enumerate(classes) if other == each]
            twins = tuple(self._in_mesh_frame(poses[j], each, path) for j in same)
            scene = name.rsplit("/", 1)[0]
            group = f"{scene}/{im_id // _SYN_BLOCK}" if scene == SYNTHETIC else scene
            record = FrameRecord(name, group, scene_id, im_id, int(indices[k]), each, k, files)
            twin = same.index(k)
            entries.append(_Entry(record, int(indices[k]), K, units, twins[twin], twins, twin))
        return entries

    def _in_mesh_frame(self, camera_from_native: np.ndarray, name: str, path: Path) -> np.ndarray:
        pose = rigid(camera_from_native[:, :3], camera_from_native[:, 3])
        if not is_rigid(torch.from_numpy(pose), tolerance=2e-3):
            raise BadData(path, "'poses' holds a matrix that is no rotation", name)
        return pose @ self._native[name]
