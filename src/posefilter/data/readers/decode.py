"""Decode a dataset's files, and say in one line what is wrong with them."""

import contextlib
import io
import math
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import ExifTags

from posefilter.data.frames import SATURATED
from posefilter.errors import BadData
from posefilter.limits import check_picture, open_picture, read_bytes

_TURNS = range(2, 9)  # of EXIF; 1: none
_DEPTH_ALONE = {b"\x93NUMPY": "an array", b"PK\x03\x04": "an archive", b"v/1\x01": "an EXR"}
_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_PALETTE = b"\x03"  # the color type of a PNG's header
_TIFF = (b"II*\0", b"MM\0*")


def read_color(path: Path) -> np.ndarray:
    """Read a color image; gray is spread to three channels, alpha dropped.  -> (H, W, 3) uint8
    RGB.
    """
    data = read_bytes(path)
    kind = next((what for head, what in _DEPTH_ALONE.items() if data.startswith(head)), None)
    if kind is not None:
        raise BadData(path, f"color is read of images alone, and this is {kind}", "save a PNG")
    image = decode_image(data, path)
    _check_upright(data, path)
    if image.dtype != np.uint8:
        found = f"found {image.dtype}; is it the depth?"
        raise BadData(path, "color image is not 8-bit", found)
    if image.ndim == 2:
        return np.repeat(image[..., None], 3, axis=-1)
    if image.shape[2] == 4 and data.startswith(_TIFF):  # OpenCV has multiplied by alpha
        with open_picture(data) as whole:
            return np.array(whole.convert("RGBA"))[..., :3].copy()
    return np.ascontiguousarray(image[..., 2::-1])


def read_size(path: Path) -> tuple[int, int]:
    """Return height and width of an image, by its header."""
    data = read_bytes(path)
    check_picture(path, data)
    with open_picture(data) as image:
        return image.height, image.width


def read_depth(path: Path, units: float, scaled_floats: bool = False) -> np.ndarray:
    """Read a depth image, or an array of depths (`.npy`).  -> (H, W) float32 [m], 0 where unknown.

    Unknown are saturated pixels, floats that are NaN or infinite, and what is negative.

    Args:
        path: A 16-bit image, or an array (H, W) of whole numbers, in `units`; or an image (TIFF) or
            array of floats, in meters.
        units: Units of whole numbers a meter.
        scaled_floats: Floats are in `units`, too, as BOP's `depth_scale` has it.

    Returns:
        Depth (H, W) float32 [m], 0 where unknown: saturated pixels count as that, floats that are
        NaN or infinite, and what is negative.

    Raises:
        BadData: The file is not such, or most of its depth is negative.
    """
    is_array, image = _is_array(path), _read_numbers(path)
    image = image[..., 0] if image.ndim == 3 and image.shape[2] == 1 else image
    image = image[0] if image.ndim == 3 and image.shape[0] == 1 else image
    found = f"found {image.dtype} {image.shape}"
    if is_array and (image.ndim != 2 or image.dtype.kind not in "fui"):
        raise BadData(path, "depth is no array (H, W) of numbers", found)
    if image.ndim == 2 and (image.dtype.kind in "fi" or is_array):
        image = np.where(np.isfinite(image), image, 0) if image.dtype.kind == "f" else image
        if np.count_nonzero(image < 0) > np.count_nonzero(image > 0):  # else it is what is unknown
            raise BadData(path, "depth is negative", f"{image.min()}; along -z?")
        image = np.maximum(image, 0)
        if (image > np.finfo(np.float32).max).any():
            raise BadData(path, "depth is too large", f"{image.max()}")
        if image.dtype.kind == "f" and not scaled_floats:
            return image.astype(np.float32)
    elif image.dtype != np.uint16 or image.ndim != 2:
        raise BadData(path, "depth is not a 16-bit image of one channel", found)
    if not (np.isfinite(units) and units > 0):
        raise BadData(path, "depth scale is not a positive number", f"{units} units a meter")
    return np.where(image == SATURATED, 0, image / np.float32(units)).astype(np.float32)


def holds_meters(path: Path) -> bool:
    """Tell whether a depth file that can be read holds floats, which are meters."""
    return _read_numbers(path).dtype.kind == "f"


def count_pictures(folder: Path) -> int:
    """Return how many color images a folder has, by their names; 0 where there is no such folder.

    Of FAT's names, `000000.left.depth.png` is none.
    """
    if not folder.is_dir():
        return 0
    names = (Path(name) for name in list_folder(folder))
    others = (".depth", ".seg")
    pictures = (name for name in names if name.suffix.lower() in (".png", ".jpg", ".jpeg", ".tif"))
    return sum(Path(name.stem).suffix not in others for name in pictures)


def read_label(path: Path) -> np.ndarray:
    """Read an image of class ids, or of a palette, whose indices are the ids.  -> (H, W) uint8 or
    uint16.
    """
    data = read_bytes(path)
    image = decode_image(data, path)
    if data.startswith(_PNG) and data[25:26] == _PALETTE:  # OpenCV has put colors for the indices
        with open_picture(data) as indices:
            return np.array(indices)
    if image.ndim == 3 and (image == image[..., :1]).all():
        image = image[..., 0]
    if image.ndim != 2 or image.dtype.kind != "u":
        found = f"found {image.dtype} {image.shape}"
        raise BadData(path, "label image has more than one channel", found)
    return image


def need(record: Any, key: str, path: Path, where: str = "") -> Any:
    """Return record[key].  Raises BadData where it is missing."""
    if not isinstance(record, dict) or key not in record:
        raise BadData(path, f"missing key '{where}{key}'")
    return record[key]


def need_list(record: Any, key: str, path: Path) -> list[Any]:
    """Return record[key].  Raises BadData where it is missing, or no list of mappings."""
    value = need(record, key, path)
    if not (isinstance(value, list) and all(isinstance(one, dict) for one in value)):
        raise BadData(path, f"'{key}' is no list of records", f"found {str(value)[:40]}")
    return value


def list_folder(folder: Path) -> list[str]:
    """Return the names in a folder.  Raises BadData where it may not be read."""
    try:
        return [path.name for path in folder.iterdir()]
    except OSError as error:
        raise BadData(folder, "cannot be read", error.strerror or type(error).__name__) from error


def numbers(
    record: Any, key: str, path: Path, shape: tuple[int, ...], where: str = ""
) -> np.ndarray:
    """Return record[key] as finite float64 of a shape.

    Raises BadData where it is missing or otherwise.
    """
    value = need(record, key, path, where)
    if isinstance(value, np.ndarray) and np.iscomplexobj(value):
        raise BadData(path, f"'{where}{key}' is not numbers", "they are complex")
    if shape == () and isinstance(value, list):  # JSON's; MATLAB's numbers are arrays
        raise BadData(path, f"'{where}{key}' is not a number", f"found {str(value)[:40]}")
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise BadData(path, f"'{where}{key}' is not numbers", str(error)) from error
    if array.size != int(np.prod(shape)):
        found = f"{array.shape}, expected {shape}"
        raise BadData(path, f"'{where}{key}' has the wrong size", found)
    if not np.isfinite(array).all():
        raise BadData(path, f"'{where}{key}' holds NaN or infinity")
    return array.reshape(shape)


def whole_number(record: Any, key: str, path: Path, where: str = "") -> int:
    """Return record[key], a whole number of 0 or more.  Raises BadData where it is none."""
    value = float(numbers(record, key, path, (), where))
    if value < 0 or value != int(value):
        raise BadData(path, f"'{where}{key}' should be a whole number, 0 or more", f"{value:g}")
    return int(value)


def expect_size(path: Path, image: np.ndarray, height: int, width: int, of: str) -> None:
    """Raise BadData where an image is not as large as `of` says."""
    if image.shape[:2] != (height, width):
        found = f"{image.shape[1]}x{image.shape[0]}"
        raise BadData(path, "wrong image size", f"{found}, but {of} says {width}x{height}")


def _is_array(path: Path) -> bool:
    return path.suffix.lower() == ".npy"


def _read_numbers(path: Path) -> np.ndarray:
    return read_array(path) if _is_array(path) else decode_image(read_bytes(path), path)


def decode_image(data: bytes, path: Path, mode: int = cv2.IMREAD_UNCHANGED) -> np.ndarray:
    """Decode an image as it is, or by another mode of OpenCV.

    Args:
        data: The file's content.
        path: Where it is, for messages.
        mode: Such as `cv2.IMREAD_COLOR`.

    Raises:
        BadData: It is damaged, or larger than photographs are.
    """
    if flaw := _flaw(data):
        raise BadData(path, "truncated or corrupt image", flaw)
    check_picture(path, data)
    image = None
    with contextlib.suppress(cv2.error):
        image = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    if image is None:
        raise BadData(path, "truncated or corrupt image", "cannot be decoded")
    return image


def read_array(path: Path) -> np.ndarray:
    """Read an array of numbers of a NumPy file, no larger than the file is."""
    data = io.BytesIO(read_bytes(path))
    try:
        version = np.lib.format.read_magic(data)
        reader = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, fortran, dtype = reader(data)
        left = data.getbuffer()[data.tell() :]
        if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(left):
            raise ValueError(f"{dtype} {shape} in {len(left)} bytes")
        array = np.frombuffer(left, dtype)
    except Exception as error:  # the header decides what breaks: its parser raises anything
        raise BadData(path, "not readable as a NumPy array", f"truncated? {error}") from error
    return array.reshape(shape, order="F" if fortran else "C")


def _check_upright(data: bytes, path: Path) -> None:
    """Raise BadData where a JPEG is stored turned, as phones do: viewers show it otherwise than it
    is read, and the depth and the intrinsics are of one or of the other.
    """
    if data[:2] != _JPEG or b"Exif\0\0" not in data[: 1 << 16]:
        return
    with open_picture(data) as image:
        turned = image.getexif().get(ExifTags.Base.Orientation, 1)
    if turned in _TURNS:
        advice = "save it as it is shown, with depth and intrinsics to match"
        raise BadData(path, f"is stored turned (EXIF orientation {turned})", advice)


def _flaw(data: bytes) -> str:
    """Return what is wrong with a PNG's or JPEG's frame, "" for nothing: decoders fill what is
    missing with gray.
    """
    if not data:
        return "the file is empty"
    if data[:2] == _JPEG:
        return "" if b"\xff\xd9" in data[-4096:] else "the JPEG has no end"
    if data[:8] != _PNG:
        return ""
    at = 8
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        end = at + 12 + length
        if end > len(data):
            break
        (crc,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(data[at + 4 : end - 4]) != crc:
            return "a PNG checksum does not match"
        if data[at + 4 : at + 8] == b"IEND":
            return ""
        at = end
    return "the PNG has no end"
