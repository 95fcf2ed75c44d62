"""What all readers share: counting what they leave out, and asking meshes about masks."""

import os
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from posefilter.data.frames import FrameRecord, Sample
from posefilter.data.readers.decode import read_label
from posefilter.data.readers.plausible import check_sample, narrow
from posefilter.data.silhouette import Geometry
from posefilter.errors import BadData
from posefilter.meshes.store import BUILTIN, MeshStore
from posefilter.paths import check_inside

# the pose of no object: a meter ahead of the camera, since a plausible one is asked for
AHEAD = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]])
_PLACE = re.compile(r"(?<=')[0-9]+(\[[0-9]+\])?\.|\[[0-9]+\]")  # of a key, in its file


class BaseReader:
    """A dataset on disk whose classes are `objects`.

    A reader fills `_entries`, one of each record with what reading it takes, or has its own
    `records`.
    """

    objects: tuple[str, ...]  # that it was asked for, or all that it has
    _entries: Sequence[Any]
    _empty: Sequence[Any] = ()  # likewise, of images that are annotated as showing none
    _shows_objects = True  # or each record is read as an image that shows none

    def __init__(self, root: str | Path, meshes: MeshStore | None, on_error: str) -> None:
        self.root, self.on_error = Path(root), on_error
        if self.root.name in ("", ".."):  # `.`: a scene has the name of its folder
            self.root = Path(os.path.abspath(root))  # noqa: PTH100  # links stay as they are
        self.skipped: Counter[str] = Counter()  # what listing left out: reasons and counts
        self.examples: dict[str, str] = {}  # of each reason to skip, the first message
        self.notes: Counter[str] = Counter()  # what else the log should say, with counts
        # image and class of what listing left out although the image shows it
        self.unlisted: set[tuple[str, str]] = set()
        self._geometry = None if meshes is None else Geometry(meshes)

    def records(self) -> Sequence[FrameRecord]:
        """Return every object of every image, in a fixed order."""
        return [entry.record for entry in self._listed("records")]

    def _listed(self, function: str) -> Sequence[Any]:
        """Return the entries, which a reader that has a function of its own may lack."""
        if not hasattr(self, "_entries"):
            raise self._lacks(function)
        return self._entries

    def _lacks(self, function: str) -> NotImplementedError:
        return NotImplementedError(f"{type(self).__name__} must implement {function}()")

    def add_empty(self) -> None:
        """Add a record of each image that is annotated as showing no object; its class is ""."""
        if self._empty:
            self._entries, self._empty = [*self._entries, *self._empty], ()

    def hide_objects(self) -> None:
        """Read every record as that of an image that shows no object: its mask is not needed.

        A reader that is a plug-in's may go on reading masks and poses.
        """
        self._shows_objects = False

    def read(self, i: int) -> Sample:
        """Return record i at the dataset's resolution, its visibility still unknown.

        Raises BadData, naming the file, where it is not as it should be.
        """
        raise self._lacks("read")

    def others(self, i: int) -> np.ndarray:
        """Return the pixels that the dataset labels as anything but record i.  -> (H, W) bool."""
        entry = self._listed("others")[i]
        label = read_label(self._files(entry.record)[2])
        return (label != 0) & ~self._mask(entry, label)

    def _mask(self, entry: Any, label: np.ndarray) -> np.ndarray:
        """Return an entry's part of an image of classes, the third of its record's files."""
        raise self._lacks("others")

    def native_from_mesh(self, name: str) -> np.ndarray:
        """Return the transform from the mesh file's frame into the dataset's own object frame.  ->
        (4, 4) [m].
        """
        raise self._lacks("native_from_mesh")

    def check_diameter(self, name: str, diameter: float) -> None:
        """Raise UserError where the dataset says that an object has another diameter [m]."""

    def visible_share(self, sample: Sample) -> float:
        """Measure the visibility of a sample, at whatever resolution; NaN where no mesh fits."""
        if self._geometry is None:
            return float("nan")
        return self._geometry.visible_share(self.objects[sample.object_id], sample)

    def _files(self, record: FrameRecord) -> tuple[Path, ...]:
        """Return a record's files.

        Raises UserError where one is a link that leads out of the dataset.
        """
        return tuple(check_inside(path, self.root) for path in record.files)

    def find_center(self, name: str) -> np.ndarray:
        """Return the center of a class's bounding box in the mesh file's frame, its origin where
        there is no mesh.  -> (3,) [m].
        """
        mesh = None if self._geometry is None else self._geometry.mesh(name)
        return np.zeros(3) if mesh is None else np.asarray(mesh.bounds).mean(0)

    def _leave_out(self, error: BadData, count: int = 1) -> None:
        """Count broken frames, or raise their error."""
        if self.on_error != "skip":
            told = [error.detail] if error.detail else []
            advice = "data.on_error=skip leaves such frames out"
            raise BadData(error.path, error.cause, "; ".join([*told, advice])) from error
        cause = _PLACE.sub("", error.cause)  # else each frame would have a cause of its own
        self.skipped[cause] += count
        self.examples.setdefault(cause, str(error))

    def _drop_absent(self) -> None:
        """Leave out classes of which no image shows any."""
        shown = {record.object for record in self.records()}
        self.objects = tuple(name for name in self.objects if name in shown)

    def _distrust_builtin(self) -> None:
        """Take no silhouettes from builtin meshes: they are not the objects of real photographs."""
        if self._geometry is not None and str(self._geometry.meshes.root) == BUILTIN:
            self._geometry = None
            self.notes[
                "builtin meshes are not the objects of these photographs: visibility stays unknown"
            ] = 1

    def _make_sample(
        self,
        i: int,
        rgb: np.ndarray,
        depth: np.ndarray,
        mask: np.ndarray,
        K: np.ndarray,
        native_from_mesh: np.ndarray,
        files: tuple[Path, ...],
    ) -> Sample:
        """Return what was read of record i, where a camera can have seen it; `files` as
        `check_sample` takes them.
        """
        entry, unknown = self._entries[i], float("nan")
        if not self._is_shown(entry):  # nothing reads the index
            sample = Sample(rgb, depth, mask, narrow(K), narrow(AHEAD), 0, i, unknown)
            return check_sample(sample, AHEAD, files)
        object_id, pose = self.objects.index(entry.record.object), entry.camera_from_object
        sample = Sample(rgb, depth, mask, narrow(K), narrow(pose), object_id, i, unknown)
        return check_sample(sample, pose @ np.linalg.inv(native_from_mesh), files)

    def _is_shown(self, entry: Any) -> bool:
        """Tell whether an entry is read as an object, not as an image that shows none."""
        return bool(entry.record.object) and self._shows_objects

    def _own_part(self, entry: Any, K: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Return an instance's part of a class's mask, which others in the image (its `twins`) may
        share.

        Raises BadData where they do, and no mesh fits.
        """
        if len(entry.twins) == 1:
            return mask
        name, parts = entry.record.object, None
        if self._geometry is not None:
            parts = self._geometry.instances(name, entry.twins, K, mask)
        if parts is None:
            why = "two instances of one class, and no mesh that fits to tell them apart"
            raise BadData(entry.record.files[2], why, name)
        return parts[entry.twin]
