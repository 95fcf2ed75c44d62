"""What every reader yields: frames of a dataset as records, and one object in one image as a
`Sample`.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from posefilter.errors import BadData

SATURATED = 65535  # what 16-bit depth images hold where the distance does not fit


@dataclass(frozen=True, eq=False)
class Sample:
    """One object in one image.  `camera_from_object` starts in the mesh file's own frame."""

    rgb: np.ndarray  # (H, W, 3) uint8
    depth: np.ndarray  # (H, W) float32 z-depth [m], 0 where unknown
    mask: np.ndarray  # (H, W) bool, the visible part of the object
    intrinsics: np.ndarray  # (3, 3) float32 [px], pixel centers at integers
    camera_from_object: np.ndarray  # (4, 4) float32 [m]
    object_id: int  # index into the reader's objects
    frame_id: int  # index into the reader's (or the split's) records
    # share of the pixels that the object would have alone in an image without edges (BOP's visible
    # fraction); NaN where unknown
    visibility: float


@dataclass(frozen=True)
class FrameRecord:
    """One object in one image, as a dataset lists it."""

    name: str  # of the image, unique in the dataset: "<group>/<frame>", as frame lists spell it
    group: str  # the scene: a split never cuts it
    scene_id: int  # these three as BOP's result files want them
    im_id: int
    obj_id: int  # the dataset's own number of the class
    object: str  # the class, as the mesh store knows it
    instance: int  # which of the image's annotations
    files: tuple[Path, ...]  # what decides the content; the first is the color image

    @property
    def key(self) -> str:
        """Return a name that no other record of the dataset has."""
        return f"{self.name}#{self.instance}"


class NotShown(BadData):
    """An object is listed but has no pixel in the label: no mistake, but nothing to learn from
    either.
    """


class Implausible(BadData):
    """A frame was read, but a camera cannot have seen what it says; it carries the sample."""

    def __init__(self, path: Path, cause: str, detail: str, sample: Sample) -> None:
        super().__init__(path, cause, detail)
        self.sample = sample
        self.args = (path, cause, detail, sample)  # by which it is pickled


def tight_box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Return (left, top, right, bottom) of the mask's pixels, right and bottom exclusive; all 0 for
    an empty mask.
    """
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if len(rows) == 0:
        return 0, 0, 0, 0
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
