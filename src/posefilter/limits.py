"""How large files of others may be: what is larger is refused before it is read or decoded."""

import io
import struct
import warnings
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from posefilter.errors import BadData

MOST_SIDE, MOST_PIXELS = 16_384, 1 << 27  # of an image: a photograph of 100 megapixels passes
MOST_BYTES = 1 << 29  # of an image's or JSON's file


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """Read a file.  Raises BadData where it is missing, or larger than such a file can be."""
    if not path.is_file():
        raise BadData(path, "missing file")
    if path.stat().st_size > most:
        raise BadData(path, "file too large", f"{path.stat().st_size:,} bytes, at most {most:,}")
    return path.read_bytes()


def check_picture(path: Path, data: bytes) -> None:
    """Raise BadData where an image's header promises more pixels than photographs have: decoding
    would fill the memory.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data)) as image:
                width, height = image.size
    except Image.DecompressionBombError as error:
        raise BadData(path, "image too large", str(error)) from error
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, struct.error) as error:
        raise BadData(path, "truncated or corrupt image", "its header cannot be read") from error
    if max(width, height) > MOST_SIDE or width * height > MOST_PIXELS:
        raise BadData(
            path, "image too large", f"{width}x{height} pixels, at most {MOST_SIDE} a side"
        )
