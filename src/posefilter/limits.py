"""How large files of others may be: what is larger is refused before it is read or decoded."""

import io
import json
import re
import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import yaml
from PIL import Image, UnidentifiedImageError

from posefilter.errors import BadData, find_reason

MOST_SIDE, MOST_PIXELS = 16_384, 1 << 27  # of an image: a photograph of 100 megapixels passes
MOST_SCANS = 100  # of a JPEG: encoders write up to 20, and each goes through all of the image
FEWEST_KNOWN = 0.001  # share of an image's pixels with depth, below which it cannot be judged
MOST_BYTES = 1 << 29  # of an image's or JSON's file
MOST_YAML = 1 << 18  # of a file of settings, or of a camera: its reader takes seconds for these
_NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
_LONGEST_NUMBER = 1000  # of YAML [signs]
_MARKER = re.compile(rb"\xff([^\x00\x01\xd0-\xd8\xff])")  # of a JPEG, that has a length or ends it
_FORMATS = ("PNG", "JPEG", "GIF", "BMP", "PPM")  # that PIL knows before it looks for more
_RARE_FORMATS = ("TIFF", "WEBP", "JPEG2000", "AVIF", "SUN")
_OTHERS = {  # by what files begin with, that are named for images
    b"\x93NUMPY": "it is an array: end its name in .npy",
    b"PK\x03\x04": "it is an archive, as .npz is: save the array by np.save",
    b"version https://git-lfs": "it is a pointer of Git LFS: run git lfs pull",
    b"<": "it is a page of the web or XML",
    b"v/1\x01": "it is an EXR: save it as .npy, or as TIFF of 32-bit floats",
    b"II*\0": "a TIFF of this kind, such as of 64-bit floats, is not read: save 32-bit floats",
    b"MM\0*": "a TIFF of this kind, such as of 64-bit floats, is not read: save 32-bit floats",
}


def read_bytes(path: Path, max_bytes: int = MOST_BYTES) -> bytes:
    """Read a file.

    Args:
        path: The file.
        max_bytes: Bytes that such a file may have.

    Raises:
        BadData: The file is missing, larger, or may not be read.
    """
    try:
        if path.is_dir():
            raise BadData(path, "is a folder, not a file")
        if not path.is_file():
            raise BadData(path, "missing file")
        size = path.stat().st_size
        if size > max_bytes:
            raise BadData(path, "file too large", f"{size:,} bytes, at most {max_bytes:,}")
        with path.open("rb") as file:
            data = file.read(size)
            # it grows, or its system tells no size
            while len(data) <= max_bytes and (more := file.read(1 << 20)):
                data += more
        if len(data) > max_bytes:
            raise BadData(path, "file too large", f"at most {max_bytes:,} bytes")
        return data
    except OSError as error:
        raise BadData(path, "cannot be read", error.strerror or type(error).__name__) from error


def _is_cut_off(data: bytes) -> bool:
    """Tell whether a file is a TIFF whose table of contents lies beyond its end."""
    order: Literal["little", "big"] = "little" if data.startswith(b"II") else "big"
    tiff = data.startswith((b"II*\0", b"MM\0*"))
    return tiff and int.from_bytes(data[4:8], order) >= len(data)


def read_lines(path: Path, max_bytes: int = 1 << 22) -> list[str]:
    """Read a text file's lines that are not empty, without the blanks round them.

    Args:
        path: The file.
        max_bytes: Bytes that such a file may have.

    Raises:
        BadData: The file is missing, larger, may not be read, or is not UTF-8.
    """
    lines = read_text(path, max_bytes).splitlines()
    return [line.strip() for line in lines if line.strip()]


def read_text(path: Path, max_bytes: int = MOST_BYTES) -> str:
    """Read a text file as it is.

    Args:
        path: The file.
        max_bytes: Bytes that such a file may have.

    Raises:
        BadData: The file is missing, larger, may not be read, or is not UTF-8.
    """
    try:
        return read_bytes(path, max_bytes).decode("utf-8-sig")  # editors of Windows mark it
    except UnicodeDecodeError as error:
        raise BadData(path, "not a text in UTF-8", str(error)) from error


def open_text(path: Path) -> io.StringIO:
    """Return a text file as a stream, with the ends of its lines as they are, as `csv` needs it.

    Args:
        path: The file.

    Raises:
        BadData: As `read_text`.
    """
    return io.StringIO(read_text(path), newline="")


def read_json(
    path: Path, max_bytes: int = MOST_BYTES, parse: Callable[[bytes], Any] = json.loads
) -> Any:
    """Read a JSON file.

    Args:
        path: The file.
        max_bytes: Bytes that such a file may have.
        parse: Makes content of its bytes; raises ValueError or RecursionError where it cannot.

    Raises:
        BadData: The file is missing, larger, may not be read, or cannot be parsed.
    """
    try:
        return parse(read_bytes(path, max_bytes))
    except (ValueError, RecursionError) as error:  # JSON, UTF-8, whole numbers too long to read
        raise BadData(path, "not readable as JSON", f"truncated? {error}") from error


def read_yaml(path: Path, most: int = MOST_YAML) -> Any:
    """Read a YAML file of plain data without aliases: one document, which empty ones may follow,
    as `ros2 topic echo` ends each message with `---`; also one of OpenCV's FileStorage.

    Args:
        path: The file.
        most: Bytes that such a file may have.

    Raises:
        BadData: The file is missing, larger, may not be read, or is no YAML.
    """
    data = read_bytes(path, most)
    try:
        # a SafeLoader, which makes nothing but plain data
        text = data.decode().removeprefix("%YAML:1.0")  # no directive of YAML's
        documents = yaml.load_all(text, Loader=PlainLoader)
        first = next(documents, None)
        if any(other is not None for other in documents):
            raise yaml.YAMLError("it has several documents: keep one of them")
        return first
    # YAML, UTF-8, days that there are not, a value that its tag (!!bool) does not fit: anything
    except Exception as error:
        raise BadData(path, "is no YAML", find_reason(error)) from error


class PlainLoader(yaml.SafeLoader):
    """YAML without aliases: a few lines of them stand for more than fits into memory. Nor are there
    long numbers: those to the base of 60 (`1:1:1`) take the square of their length.
    """

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose a node.  Raises yaml.YAMLError for an alias, or a long number."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("it has an alias (*name), which settings do not need")
        node: Any = super().compose_node(parent, index)
        if node.tag in _NUMBERS and len(node.value) > _LONGEST_NUMBER:
            raise yaml.YAMLError(f"it has a number of {len(node.value):,} signs")
        return node


# OpenCV's, as its JSON has it: rows, cols, dt, data
PlainLoader.add_constructor("tag:yaml.org,2002:opencv-matrix", PlainLoader.construct_yaml_map)


def open_picture(data: bytes) -> Image.Image:
    """Open a picture of a format that pictures have, whatever its file is called.

    Raises UnidentifiedImageError for others: PIL would start Ghostscript, a program, for EPS.
    """
    try:
        return Image.open(io.BytesIO(data), formats=_FORMATS)
    except UnidentifiedImageError:
        Image.init()
        others = [kind for kind in _RARE_FORMATS if kind in Image.OPEN]  # AVIF: not in older PIL
        return Image.open(io.BytesIO(data), formats=others)


def check_picture(path: Path, data: bytes) -> int:
    """Return the number of an image's pixels.

    Raises BadData where its header promises more than photographs have, or a JPEG has more scans:
    decoding would fill the memory, or not end.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with open_picture(data) as image:
                width, height = image.size
    except Image.DecompressionBombError as error:
        raise BadData(path, "image too large", str(error)) from error
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, struct.error) as error:
        known = next((what for head, what in _OTHERS.items() if data.startswith(head)), None)
        if known is not None and not _is_cut_off(data):
            raise BadData(path, "is no image that can be read", known) from error
        raise BadData(path, "truncated or corrupt image", "its header cannot be read") from error
    if max(width, height) > MOST_SIDE or width * height > MOST_PIXELS:
        raise BadData(
            path, "image too large", f"{width}x{height} pixels, at most {MOST_SIDE} a side"
        )
    if data.startswith(b"\xff\xd8") and _has_many_scans(data):
        raise BadData(path, "image too large", f"a JPEG of more than {MOST_SCANS} scans")
    return int(width * height)


def _has_many_scans(data: bytes) -> bool:
    """Tell whether a JPEG, up to its end, has more scans than images need."""
    at, scans = 2, 0
    while (found := _MARKER.search(data, at)) and found[1] != b"\xd9":
        scans += found[1] == b"\xda"
        if scans > MOST_SCANS:
            return True
        # a segment says its length; behind that of a scan come its data, which have no marker
        at = found.end() + max(int.from_bytes(data[found.end() : found.end() + 2], "big"), 2)
    return False
