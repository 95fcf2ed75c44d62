"""Videos: frames in their order, from a folder of pictures or from a dataset."""

import contextlib
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from posefilter.data.frames import FrameRecord, NotShown
from posefilter.data.readers.base import BaseReader
from posefilter.data.readers.checked import read_checked
from posefilter.data.readers.decode import (
    expect_size,
    holds_meters,
    list_folder,
    read_color,
    read_depth,
    read_size,
)
from posefilter.errors import BadData, UserError, naming
from posefilter.geometry.lens import undistort_most

_ASKED = 50  # color pictures, whose commonest size is the video's where no camera's file says one
_TIME = re.compile(r"\d+\.\d+|\d{10,}")
_COLOR = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff", ".ppm")
_DEPTH = (".png", ".npy", ".tif", ".tiff", ".pgm", ".pfm")


@dataclass(frozen=True, eq=False)
class VideoFrame:
    """One frame of a video, with the poses that are known in it."""

    name: str  # of the image, unique in the video
    im_id: int  # the number in its file's name, or the dataset's
    rgb: np.ndarray  # (H, W, 3) uint8
    depth: np.ndarray  # (H, W) float32 z-depth [m], 0 where unknown
    intrinsics: np.ndarray  # (3, 3) [px]
    truth: dict[str, np.ndarray]  # by object: camera_from_object (4, 4) [m], mesh frame


class Video(ABC):
    """Frames in their order; they are read when they are come to."""

    name: str
    scene_id: int
    objects: tuple[str, ...] | None  # that are known to be in it; None: that is not known
    ids: dict[str, int]  # their numbers in the dataset
    several: tuple[str, ...] = ()  # objects that a frame shows more than once
    _frames: Sequence[Any]  # what reading each takes

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._frames)

    @abstractmethod
    def read(self, index: int) -> VideoFrame | None:
        """Return a frame; None where the dataset cannot show it.

        Raises:
            BadData: A file is not as it should be.
        """

    def __iter__(self) -> Iterator[VideoFrame]:
        """Yield the frames."""
        for index in range(len(self)):
            frame = self.read(index)
            if frame is not None:
                yield frame


class FolderVideo(Video):
    """A folder with `rgb/` and `depth/`: pictures of the same names, or as many of each, in order.

    Where the names are times, each color picture must be nearest to its own depth picture; where
    they are counted, the numbers of all pairs must be as far apart.

    Where the color pictures' names differ in one number alone (`000123.png`, `frame_7_rgb.png`),
    the frames are in its order, and it is their `im_id`. Otherwise they are in the order of the
    names, and `im_id` is the place in it, from 0.

    Args:
        folder: The folder.
        intrinsics: (3, 3) camera matrix of all frames [px].
        depth_scale: Units of the depth images in a meter.
        stride: Take every so many frames.
        distortion: Of the lens, see `undistort_most`; None: the pictures are rectified.
        size: Height and width that the intrinsics are of [px]; None: that of most pictures.
        skip: Let color pictures without depth be, where others have some: reading them fails.

    Raises:
        UserError: A folder is missing or empty, or the pictures do not pair.
    """

    scene_id = 0
    objects: tuple[str, ...] | None = None

    def __init__(
        self,
        folder: Path,
        intrinsics: np.ndarray,
        depth_scale: float,
        stride: int = 1,
        distortion: tuple[float, ...] | None = None,
        size: tuple[int, int] | None = None,
        skip: bool = False,
    ) -> None:
        self.name, self._K, self._scale = folder.resolve().name, intrinsics, depth_scale
        self._distortion, self._size, self._sized = distortion, size, "the camera's file"
        self.ids: dict[str, int] = {}
        color, numbers = _list_pictures(folder, "rgb", _COLOR)
        depth, others = _list_pictures(folder, "depth", _DEPTH)
        by_stem = {path.stem: path for path in depth}
        alone = [path.name for path in color if path.stem not in by_stem]
        if not alone or (skip and len(alone) < len(color)):
            depth = [
                by_stem.get(path.stem, folder / "depth" / f"{path.stem}.png") for path in color
            ]
        elif len(alone) < len(color):
            raise UserError(
                f"frames={folder}: rgb/{alone[0]} has no picture of its name in depth/, as "
                f"{len(alone)} of {len(color)}, and the others have; on_error=skip leaves such "
                "frames out"
            )
        elif len(color) != len(depth):
            raise UserError(
                f"frames={folder}: {len(color)} pictures in rgb/ and {len(depth)} in depth/, of "
                f"other names; name both alike"
            )
        elif all(_TIME.fullmatch(path.stem) for path in (*color, *depth)):
            _check_times(folder, color, depth)
        elif numbers is not None and others is not None:
            _check_numbers(folder, color, numbers, others)
        places = numbers or range(len(color))
        self._frames = [*zip(places, color, depth, strict=True)][::stride]

    @property
    def holds_meters(self) -> bool:
        """Whether the depth is of floats, which are meters; by the first file that can be read."""
        for _, _, depth in self._frames:
            with contextlib.suppress(BadData):
                return holds_meters(depth)
        return False

    def read(self, index: int) -> VideoFrame:
        """Return a frame."""
        number, color, depth = self._frames[index]
        rgb, z = read_color(color), read_depth(depth, self._scale)
        expect_size(depth, z, rgb.shape[0], rgb.shape[1], color.name)
        if self._size is None:  # the intrinsics are of one size
            self._size, self._sized = self._find_size()
        expect_size(color, rgb, *self._size, self._sized)
        if self._distortion is not None:
            with naming(f"frame {color.stem}"):
                rgb, z = undistort_most(rgb, z, self._K, self._distortion)
        return VideoFrame(color.stem, number, rgb, z, self._K, {})

    def _find_size(self) -> tuple[tuple[int, int], str]:
        """Return height and width of most pictures, or of the first such, and which has them."""
        sizes: dict[str, tuple[int, int]] = {}
        for _, color, _ in self._frames[:: max(1, len(self._frames) // _ASKED)]:
            with contextlib.suppress(BadData):
                sizes[color.name] = read_size(color)
        ((common, _),) = Counter(sizes.values()).most_common(1)
        return common, next(name for name, size in sizes.items() if size == common)


class Scene(NamedTuple):
    """What one camera sees of one place: a video. FAT has folders of the same place, and each of
    two cameras.
    """

    group: str  # as the records name it
    scene_id: int
    name: str  # no other scene's of the dataset: the group, or the images' folder and camera


class SceneVideo(Video):
    """A scene of a dataset, with the true poses of the objects that are asked for.

    Args:
        reader: Of the dataset.
        scene: Which of `list_scenes`.
        objects: Whose poses are to be known.
        stride: Take every so many frames.
    """

    def __init__(
        self, reader: BaseReader, scene: Scene, objects: Sequence[str], stride: int = 1
    ) -> None:
        self.name, self.scene_id = scene.name, scene.scene_id
        self._reader, self._wanted = reader, set(objects)
        frames: dict[int, list[tuple[int, FrameRecord]]] = {}
        for index, record in enumerate(reader.records()):
            if (record.group, record.scene_id) == scene[:2]:
                frames.setdefault(record.im_id, []).append((index, record))
        self._frames = [frames[number] for number in sorted(frames)][::stride]
        own = [record for frame in self._frames for _, record in frame if record.object in objects]
        self.objects: tuple[str, ...] | None = tuple(
            name for name in objects if any(r.object == name for r in own)
        )
        self.ids = {record.object: record.obj_id for record in own}
        counts = Counter((record.im_id, record.object) for record in own)
        self.several = tuple(sorted({name for (_, name), count in counts.items() if count > 1}))

    def read(self, index: int) -> VideoFrame | None:
        """Return a frame; None where nothing of it is labeled, so that no reader opens it."""
        truth: dict[str, np.ndarray] = {}
        sample = None
        # of the others only the picture is needed, where none of the wanted gives it
        frames = sorted(self._frames[index], key=lambda one: one[1].object not in self._wanted)
        for number, record in frames:
            wanted = record.object in self._wanted and record.object not in truth
            if sample is not None and not wanted:
                continue
            try:
                sample = read_checked(self._reader, number, record)
            except NotShown:
                continue
            if wanted:
                truth[record.object] = sample.camera_from_object.astype(np.float64)
        if sample is None:
            return None
        K, record = sample.intrinsics.astype(np.float64), self._frames[index][0][1]
        return VideoFrame(record.name, record.im_id, sample.rgb, sample.depth, K, truth)


def list_scenes(reader: BaseReader) -> list[Scene]:
    """Return the scenes of a dataset, in the order of their records."""
    first: dict[tuple[str, int], FrameRecord] = {}
    for record in reader.records():
        first.setdefault((record.group, record.scene_id), record)
    many = Counter(group for group, _ in first)
    return [
        Scene(*key, key[0] if many[key[0]] == 1 else _name_of_folder(record.name))
        for key, record in first.items()
    ]


def _name_of_folder(image: str) -> str:
    """Return the folder of an image and the camera: mixed/kitchen_0.left of
    mixed/kitchen_0/000001.left.
    """
    path = PurePosixPath(image)
    return f"{path.parent}{path.suffix}"


def number_names(names: Sequence[str]) -> list[int] | None:
    """Return the number in each name; None where names do not differ in one number alone."""
    parts = [re.split(r"(\d+)", name) for name in names]  # numbers are at odd places
    if len({len(part) for part in parts}) != 1 or len(parts[0]) == 1:
        return None
    columns = [*zip(*parts, strict=True)]
    differ = [i for i, column in enumerate(columns) if len({*column}) > 1]
    place = differ[0] if differ else len(columns) - 2  # of one name: its last number
    if len(differ) > 1 or place % 2 == 0:
        return None
    numbers = [int(part) for part in columns[place]]
    return numbers if len({*numbers}) == len(names) else None


def _check_times(folder: Path, color: Sequence[Path], depth: Sequence[Path]) -> None:
    """Raise UserError where pictures that are named by times, and paired by order, are not the
    nearest in time. Times have a fraction or ten digits and more; other numbers may be counts.
    """
    own, other = (np.array([float(path.stem) for path in paths]) for paths in (color, depth))
    order = np.argsort(other)
    after = np.searchsorted(other[order], own).clip(1, max(len(other) - 1, 1))
    beside = np.stack([order[after - 1], order[after.clip(max=len(order) - 1)]])
    distance = np.abs(own - other[beside])
    nearest = beside[distance.argmin(0), np.arange(len(own))]
    wrong = np.flatnonzero(np.abs(own - other) > distance.min(0))
    if len(wrong):
        first = wrong[0]
        raise UserError(
            f"frames={folder}: rgb/{color[first].name} is paired by order with "
            f"depth/{depth[first].name}, but depth/{depth[nearest[first]].name} is nearer in "
            f"time ({len(wrong)} of {len(color)}); name both alike"
        )


def _check_numbers(
    folder: Path, color: Sequence[Path], numbers: Sequence[int], others: Sequence[int]
) -> None:
    """Raise UserError where pictures are counted, and the numbers of those that are paired by order
    contradict each other, as where one of either is missing. Counts may begin differently.
    """
    apart = [other - number for number, other in zip(numbers, others, strict=True)]
    if len({*apart}) > 1:
        i = next(i for i, each in enumerate(apart) if each != apart[0])
        raise UserError(
            f"frames={folder}: rgb/{color[i].name} would be paired by order with number "
            f"{others[i]} in depth/: is number {numbers[i] + apart[0]} missing? Name both alike"
        )


def _list_pictures(
    folder: Path, name: str, endings: Sequence[str]
) -> tuple[list[Path], list[int] | None]:
    """Return the pictures of a folder within, in order, and their numbers; None: they have none."""
    inner = folder / name
    if not inner.is_dir():
        raise UserError(f"frames={folder}: has no folder {name}/; expected rgb/ and depth/")
    names = [one for one in list_folder(inner) if not one.startswith(".")]  # as macOS adds
    found = sorted(inner / one for one in names if Path(one).suffix.lower() in endings)
    by_stem = dict[str, Path]()
    for path in found:
        if (twin := by_stem.setdefault(path.stem, path)) is not path:
            raise UserError(
                f"frames={folder}: {name}/{twin.name} and {name}/{path.name} are of one name"
            )
    if not found:
        raise UserError(f"frames={folder}: no pictures in {name}/ ({', '.join(endings)})")
    if all(re.fullmatch(r"\d+\.\d+", path.stem) for path in found):  # times: .5 is after .25
        return sorted(found, key=lambda path: float(path.stem)), None
    numbers = number_names([path.stem for path in found])
    if numbers is None:
        return found, None
    order = sorted(range(len(found)), key=numbers.__getitem__)
    return [found[i] for i in order], [numbers[i] for i in order]
