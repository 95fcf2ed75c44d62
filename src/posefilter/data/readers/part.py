"""A part of an object as an object of its own: `hammer.head` in a dataset of hammers."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from posefilter.data.frames import FrameRecord, NotShown, Sample
from posefilter.data.readers.base import BaseReader
from posefilter.data.silhouette import Geometry
from posefilter.meshes.parts import split_part, take_faces
from posefilter.meshes.store import MeshStore


class PartReader(BaseReader):
    """The dataset of an object, with one of its parts in the object's place.

    Pose and frame are the object's; the mask has those of its visible pixels where the part's faces
    are seen at the true pose. Images that show the object but not the part are left out.

    Args:
        whole: A reader of the object alone.
        name: `OBJECT.PART`.
        meshes: Where the object's mesh and its parts are.
    """

    _geometry: Geometry

    def __init__(self, whole: BaseReader, name: str, meshes: MeshStore) -> None:
        self._whole, self._name, self._meshes = whole, name, meshes
        self.objects = (name,)
        self.skipped, self.examples, self.notes = whole.skipped, whole.examples, whole.notes
        base, part = split_part(name)
        mesh = meshes.load(base)
        own = mesh.parts[part]
        self._base, self._geometry = base, Geometry(meshes)
        self._solids = [meshes.load(name)]
        if not own.all():
            self._solids.append(take_faces(mesh, ~own, f"{base} without {part}"))

    def records(self) -> Sequence[FrameRecord]:
        """Return the object's records, of the part's name."""
        return [replace(record, object=self._name) for record in self._whole.records()]

    def read(self, i: int) -> Sample:
        """Return record i with the part's mask.

        Raises BadData as the object's reader does, and NotShown where the part is not seen.
        """
        sample = self._whole.read(i)
        seen = sample.mask & (self._see(sample) == 0)
        if not seen.any():
            file = self._whole.records()[i].files[0]
            raise NotShown(file, "the part is not seen", self._name)
        return replace(sample, mask=seen, object_id=0)

    def visible_share(self, sample: Sample) -> float:
        """Measure which share of the part is visible, of what it would show alone."""
        return self._geometry.visible_share(self._name, sample)

    def others(self, i: int) -> np.ndarray:
        """Return the pixels of anything else, the object's other parts among them."""
        sample = self._whole.read(i)
        rest: np.ndarray = self._whole.others(i) | (sample.mask & (self._see(sample) != 0))
        return rest

    def native_from_mesh(self, name: str) -> np.ndarray:
        """Return the object's own: a part has the frame of the whole."""
        return self._whole.native_from_mesh(self._base)

    def _see(self, sample: Sample) -> np.ndarray:
        """Return what is seen of the object alone: (H, W), 0 the part, 1 the rest, -1 neither."""
        height, width = sample.mask.shape
        poses = [sample.camera_from_object] * len(self._solids)
        _, index = self._geometry.render(self._solids, poses, sample.intrinsics, (height, width))
        return index
