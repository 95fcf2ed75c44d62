"""A dataset of one .npz file a frame: <root>/<scene>/<frame>.npz."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from posefilter.data.frames import FrameRecord, Sample
from posefilter.data.readers.base import BaseReader
from posefilter.meshes.store import MeshStore


class NpzReader(BaseReader):
    """Each file has rgb, depth, mask, intrinsics and camera_from_object, as `Sample` describes
    them.
    """

    def __init__(
        self, root: str | Path, objects: str | Sequence[str] | None = None,
        meshes: MeshStore | None = None, on_error: str = "raise",
    ) -> None:  # fmt: skip
        super().__init__(root, meshes, on_error)
        self.objects = (objects,) if isinstance(objects, str) else tuple(objects or ["object"])
        files = sorted(self.root.glob("*/*.npz"))
        scenes = sorted({file.parent.name for file in files})
        self._records = [
            FrameRecord(
                f"{file.parent.name}/{file.stem}", file.parent.name,
                scenes.index(file.parent.name), i, 0, self.objects[0], 0, (file,),
            )
            for i, file in enumerate(files)
        ]  # fmt: skip

    def records(self) -> Sequence[FrameRecord]:
        """Return one record a file."""
        return self._records

    def read(self, i: int) -> Sample:
        """Read a frame."""
        with np.load(self._files(self._records[i])[0]) as frame:  # no pickles
            names = ("rgb", "depth", "mask", "intrinsics", "camera_from_object")
            return Sample(*(frame[name] for name in names), 0, i, float("nan"))

    def others(self, i: int) -> np.ndarray:
        """Return no pixels: only one object is labeled."""
        return np.zeros_like(self.read(i).mask)

    def native_from_mesh(self, name: str) -> np.ndarray:
        """Return the identity: poses are of the mesh file's frame."""
        return np.eye(4)
