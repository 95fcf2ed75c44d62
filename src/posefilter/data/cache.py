"""Keep decoded, resized frames, so that training waits for no decoder: in memory, on disk, or not
at all.

Color stays 8-bit, depth becomes 16-bit (0.1 mm a unit; beyond `FARTHEST` it counts as unknown),
masks become bits.
"""

import hashlib
import io
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from posefilter.data.frames import FrameRecord, Sample
from posefilter.errors import UserError
from posefilter.files import open_whole, remove_parts, stamp_files, write_whole
from posefilter.paths import check_inside, check_links

CACHES = ("memory", "disk", "none")
_HEADER = 4096  # bytes, at most, ahead of an array
_UNITS = 10_000.0  # a meter
FARTHEST = 65535 / _UNITS  # [m] depth that is kept
# of the files of a `DiskCache`: one more whenever they change, so that none of another layout is
# read
_LAYOUT = 5
_STALE = 3600.0  # [s] after which a file that is not whole has no writer any more


@dataclass(frozen=True, eq=False)
class Prepared:
    """What is kept of one record beside its image."""

    mask_bits: np.ndarray  # (ceil(H W / 8),) uint8
    shape: tuple[int, int]
    intrinsics: np.ndarray  # (3, 3)
    camera_from_object: np.ndarray  # (4, 4)
    object_id: int
    visibility: float

    @property
    def pixels(self) -> int:
        """Return how many pixels the mask has."""
        return int(np.unpackbits(self.mask_bits).sum())


class MemoryCache:
    """Keep frames in this process's memory; forked loader workers share it."""

    def __init__(self) -> None:
        self._images: dict[str, np.ndarray] = {}
        self._records: dict[str, Prepared] = {}

    def find(self, record: FrameRecord) -> Prepared | None:
        """Return what is kept of a record."""
        return self._records.get(record.key)

    def keep(self, record: FrameRecord, sample: Sample) -> Prepared:
        """Keep a sample; records of one image share its pixels."""
        self._images.setdefault(record.name, pack_image(sample))
        self._records[record.key] = prepared = prepare(sample)
        return prepared

    def load(self, record: FrameRecord, frame_id: int) -> Sample:
        """Return a kept sample."""
        return unpack(self._images[record.name], self._records[record.key], frame_id)


class DiskCache:
    """Keep frames in a folder, one file an image and one a record, for this and later runs.

    A file is written whole or not at all. A record's is out of date as soon as a source file's size
    or time of change differs; an image's is named by its content, since the depth's unit may be in
    any of the source files, and records of one image share it.
    """

    def __init__(self, folder: Path, version: str) -> None:
        """Use a folder; `version` says all that decides the content beside the source files (size,
        class list, meshes).
        """
        check_inside(folder, folder.parent)  # a dataset may bring a link of that name
        self.folder = folder / hashlib.sha256(f"{_LAYOUT} {version}".encode()).hexdigest()[:16]
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            check_inside(self.folder, folder)
            check_links(self.folder, "set data.cache_dir")  # nor may what it brings lead out
            write_whole(
                self.folder / "README",
                f"decoded frames; may be deleted while no run uses them\n{version}\n",
            )
            remove_parts(self.folder, ["*"], _STALE)
        except OSError as error:
            raise UserError(
                f"{folder}: the cache cannot be written ({error.strerror}); set data.cache_dir or "
                f"data.cache=memory"
            ) from error
        self._records: dict[str, Prepared] = {}
        self._images: dict[str, Path] = {}  # by the record's key

    def find(self, record: FrameRecord) -> Prepared | None:
        """Return what is kept of a record, None where a source file has changed."""
        if record.key not in self._records:
            path = self._record_path(record)
            if not path.is_file():
                return None
            try:
                one, digest = _read_prepared(path)
            # a damaged archive, a header that lies of its array: their readers raise anything
            except Exception as error:
                raise self._damaged(path) from error
            image = self._image_path(digest)
            if not image.is_file():
                return None
            self._records[record.key], self._images[record.key] = one, image
        return self._records[record.key]

    def keep(self, record: FrameRecord, sample: Sample) -> Prepared:
        """Write a sample."""
        one, pixels = prepare(sample), pack_image(sample)
        digest = hashlib.sha256(pixels.data).digest()
        image = self._image_path(digest)
        if not image.is_file():
            packed = io.BytesIO()  # into a file, NumPy tells a full disk without its number
            np.save(packed, pixels)
            write_whole(image, packed.getbuffer())
        parts = {
            "image": np.frombuffer(digest, np.uint8),
            "mask_bits": one.mask_bits,
            "numbers": np.array([*one.shape, one.object_id]),
            "intrinsics": one.intrinsics,
            "pose": one.camera_from_object,
            "visibility": np.array(one.visibility),
        }
        with open_whole(self._record_path(record), sync=False) as file:
            np.savez(file, allow_pickle=False, **parts)
        self._records[record.key], self._images[record.key] = one, image
        return one

    def load(self, record: FrameRecord, frame_id: int) -> Sample:
        """Return a kept sample."""
        one = self.find(record)
        if one is None:
            raise UserError(f"{record.files[0]}: changed while it was in use; start again")
        path, (height, width) = self._images[record.key], one.shape
        try:
            size = path.stat().st_size
        except FileNotFoundError as error:
            raise UserError(f"{path}: was deleted while it was in use; start again") from error
        if size > 5 * height * width + _HEADER:
            raise self._damaged(path)
        try:
            return unpack(np.load(path), one, frame_id)
        except Exception as error:  # as above
            raise self._damaged(path) from error

    def _damaged(self, path: Path) -> UserError:
        return UserError(f"{path}: a damaged file of the cache; delete {self.folder}")

    def _image_path(self, digest: bytes) -> Path:
        return self._path(digest, ".npy")

    def _record_path(self, record: FrameRecord) -> Path:
        name = f"{record.key} {record.object} {stamp_files(record.files)}"
        return self._path(hashlib.sha256(name.encode()).digest(), ".npz")

    def _path(self, digest: bytes, suffix: str) -> Path:
        code = digest.hex()[:24]
        return self.folder / code[:2] / f"{code}{suffix}"


class NoCache(MemoryCache):
    """Keep nothing but the numbers: decode anew each time."""

    def __init__(self, read: Callable[[FrameRecord], Sample]) -> None:
        super().__init__()
        self._read = read

    def keep(self, record: FrameRecord, sample: Sample) -> Prepared:
        """Keep the numbers."""
        self._records[record.key] = prepared = prepare(sample)
        return prepared

    def load(self, record: FrameRecord, frame_id: int) -> Sample:
        """Return the sample, decoded anew."""
        one, sample = self._records[record.key], self._read(record)
        return unpack(pack_image(sample), one, frame_id)


FrameCache = MemoryCache | DiskCache


def open_cache(
    kind: str, folder: Path, version: str, read: Callable[[FrameRecord], Sample]
) -> FrameCache:
    """Return a cache: "memory", "disk" in a folder (see `DiskCache` for `version`), or "none",
    which reads anew.
    """
    if kind == "disk":
        return DiskCache(folder, version)
    return MemoryCache() if kind == "memory" else NoCache(read)


def prepare(sample: Sample) -> Prepared:
    """Return what is kept of a sample beside its image."""
    height, width = sample.mask.shape
    pose, K = sample.camera_from_object.astype(np.float32), sample.intrinsics.astype(np.float32)
    bits, visibility = np.packbits(sample.mask), float(sample.visibility)
    return Prepared(bits, (height, width), K, pose, sample.object_id, visibility)


def pack_image(sample: Sample) -> np.ndarray:
    """Return color and depth in one array, one after the other.  -> (5 H W,) uint8."""
    units = np.round(sample.depth * _UNITS)
    depth = np.where(units > 65535, 0, units).astype("<u2")
    return np.concatenate([sample.rgb.ravel(), depth.ravel().view(np.uint8)])


def unpack(image: np.ndarray, one: Prepared, frame_id: int) -> Sample:
    """Return the sample that was packed."""
    height, width = one.shape
    rgb, depth = np.split(image, [3 * height * width])
    rgb = rgb.reshape(height, width, 3).copy()
    depth = depth.view("<u2").reshape(height, width) / np.float32(_UNITS)
    mask = np.unpackbits(one.mask_bits, count=height * width).reshape(height, width).astype(bool)
    K, pose = one.intrinsics.copy(), one.camera_from_object.copy()
    return Sample(rgb, depth, mask, K, pose, one.object_id, frame_id, one.visibility)


def _read_prepared(path: Path) -> tuple[Prepared, bytes]:
    """Read what was kept of a record, and the digest of its image.

    Raises ValueError where the file is larger than what it says.
    """
    with zipfile.ZipFile(path) as archive:
        if sum(part.file_size for part in archive.infolist()) > path.stat().st_size:
            raise ValueError("its parts claim to be larger than the file")
    with np.load(path) as kept:
        height, width, object_id = (int(x) for x in kept["numbers"])
        bits, visibility = kept["mask_bits"], float(kept["visibility"])
        if len(bits) != -(-height * width // 8):
            raise ValueError("its mask is not of the image's size")
        K, pose = kept["intrinsics"], kept["pose"]
        digest = kept["image"].tobytes()
        return Prepared(bits, (height, width), K, pose, object_id, visibility), digest
