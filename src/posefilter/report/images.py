"""The pictures that a run left: which section each belongs to, and how each is packed into a
page.
"""

import base64
import re
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from PIL import UnidentifiedImageError

from posefilter.errors import BadData
from posefilter.limits import MOST_BYTES, check_picture, open_picture, read_bytes

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".gif")
SECTIONS = {  # the first whose words a picture's name has; what is in none is "more"
    "worst": {"worst"},
    "best": {"best"},
    "overlays": {"overlay", "overlays", "estimate", "estimates", "pose", "poses"},
    "belief": {
        "belief", "beliefs", "so3", "rotations", "likelihood", "field", "points", "proposals",
        "objectness", "marginals",
    },
    "particles": {
        "trajectories", "particles", "cloud", "clouds", "animation", "video", "row", "silhouettes",
        "diagnostics", "health", "filter",
    },
}  # fmt: skip
LARGEST_PX = 2000
WIDE_PX = 900  # from which width on an image is several in a row, which a phone scrolls
KEPT_BYTES = 60_000


class StoredImage(NamedTuple):
    """A picture as it is in its file."""

    name: str
    caption: str
    data: bytes


def read_images(folder: Path) -> list[StoredImage]:
    """Return the pictures of a folder, sorted by name as people count; empty where there is
    none.

    Raises:
        BadData: One may not be read, or all together are larger than the pictures of a run.
    """
    if not folder.is_dir():
        return []
    files = [one for one in folder.iterdir() if one.suffix.lower() in SUFFIXES and one.is_file()]
    files.sort(key=lambda path: sort_by_number(path.name))
    size = sum(path.stat().st_size for path in files)
    if size > MOST_BYTES:
        raise BadData(folder, "pictures too large", f"{size:,} bytes, at most {MOST_BYTES:,}")
    return [StoredImage(p.stem, p.stem.replace("_", " "), read_bytes(p)) for p in files]


def sort_by_number(name: str) -> list[tuple[int, str]]:
    """Return a sorting key in which 2 comes before 10."""
    return [
        (int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)
    ]


def group_by_section(pictures: list[StoredImage]) -> dict[str, list[StoredImage]]:
    """Return the pictures of each section, in its order; "more" holds the rest."""
    out: dict[str, list[StoredImage]] = {section: [] for section in (*SECTIONS, "more")}
    for picture in pictures:
        own = {*re.split(r"[^a-z0-9]+", picture.name.lower())}  # its words, whatever joins them
        section = next((section for section, keys in SECTIONS.items() if own & keys), "more")
        out[section].append(picture)
    return out


def encode_image(data: bytes) -> tuple[str, int, int]:
    """Return a picture as a data URI with its width and height [px]: large ones smaller, animations
    as they are.

    Raises ValueError where the bytes are no picture, or one of more pixels than can be decoded.
    """
    try:
        check_picture(Path("picture"), data)
        with open_picture(data) as image:
            kind, (width, height) = (image.format or "").lower(), image.size
            if len(data) > KEPT_BYTES and getattr(image, "n_frames", 1) == 1:
                image.thumbnail((LARGEST_PX, LARGEST_PX))
                width, height = image.size
                stream = BytesIO()
                image.convert("RGB").save(stream, "WEBP", quality=86, method=2)
                data, kind = stream.getvalue(), "webp"
            else:
                image.load()
    except (BadData, UnidentifiedImageError, OSError, SyntaxError) as error:
        raise ValueError(f"no picture: {error}") from error
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}", width, height


def encode_png(png: bytes) -> str:
    """Return a PNG as a data URI."""
    return "data:image/png;base64," + base64.b64encode(png).decode()
