"""Files of the YCB-Video dataset: class names, scenes, lists of frames, meta data."""

import io
import re
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import scipy.io

from posefilter.data.readers.decode import list_folder
from posefilter.errors import BadData, UserError
from posefilter.limits import read_bytes, read_lines
from posefilter.meshes import ycb
from posefilter.paths import find_list, is_plain_name

FRAME = re.compile(r"[0-9]{1,9}")


_KEYS = ["cls_indexes", "poses", "factor_depth", "intrinsic_matrix"]


# bytes of a -meta.mat, of which there may be 2 MB, and of a list
_LARGEST_META = 1 << 25
# of a MATLAB file: bytes before its first array, the kind of a packed one, and how far its name is
_MAT_HEADER, _PACKED, _MAT_NAMED = 128, 15, 1024


_LONGEST_LIST = 1 << 22


# rendered frames have no scenes: blocks stand in, numbered from here
SYNTHETIC = "data_syn"


def read_class_names(root: Path) -> tuple[str, ...]:
    for path in (
        root / "image_sets" / "classes.txt",
        root / "classes.txt",
        root.parent / "image_sets" / "classes.txt",  # of root=X/data
        root.parent / "classes.txt",
    ):
        if path.is_file():
            names = tuple(read_lines(path, _LONGEST_LIST))
            wrong = [name for name in names if not is_plain_name(name)]
            if wrong:
                raise UserError(f"{path}: class with an impossible name {wrong[0][:40]!r}")
            return names
    return ycb.CLASSES


def list_scenes(root: Path, subsets: set[str]) -> Iterator[tuple[str, Path]]:
    """Yield scenes by name: those of `data` by number, `data_syn` as one.

    Raises:
        UserError: A folder of frames in `data` has another name: it would be left out.
    """
    if list_stems(root):
        yield root.name, root
        return
    if SYNTHETIC in subsets and (root / SYNTHETIC).is_dir():
        yield SYNTHETIC, root / SYNTHETIC
    data = root / "data" if (root / "data").is_dir() else root
    if "data" in subsets:
        for name in list_folder(data):
            if name == SYNTHETIC or not (data / name).is_dir():
                continue
            if FRAME.fullmatch(name):
                yield name, data / name
            elif _holds_frames(data / name):
                raise UserError(
                    f"{data / name}: scenes are named by numbers, such as 0001; rename it, or move "
                    "it out of the dataset"
                )


def _holds_frames(folder: Path) -> bool:
    with suppress(BadData):  # it may not be read, and need not
        return bool(list_stems(folder))
    return False


def list_stems(folder: Path) -> list[str]:
    names = list_folder(folder)
    return [name.removesuffix("-meta.mat") for name in names if name.endswith("-meta.mat")]


def read_frame_list(root: Path, listed: str | Path) -> list[str]:
    path = find_list(str(listed), root)
    if path is None:
        raise UserError(f"{listed}: no such list of frames (data.options.frames), nor below {root}")
    names = read_lines(path, _LONGEST_LIST)
    if not names or any("/" not in name for name in names):
        raise UserError(f"{path}: not a list of frames; expected lines such as 0048/000001")
    return [*dict.fromkeys(names)]  # a frame that is listed twice is read once


def _check_packed(content: bytes) -> None:
    """Raise ValueError where an array that is read of a MATLAB file is packed, and much larger
    than those of a frame: unpacking it would fill the memory.
    """
    order: Literal["little", "big"] = "big" if content[126:128] == b"MI" else "little"
    at = _MAT_HEADER
    while at + 8 <= len(content):
        kind, size = (int.from_bytes(content[i : i + 4], order) for i in (at, at + 4))
        if kind == _PACKED:
            unpacking = zlib.decompressobj()
            head = unpacking.decompress(content[at + 8 : at + 8 + size], _MAT_NAMED)
            if any(key.encode() in head for key in _KEYS):
                unpacking.decompress(unpacking.unconsumed_tail, _LARGEST_META)
                if unpacking.unconsumed_tail:
                    raise ValueError(f"an array of more than {_LARGEST_META:,} bytes")
        at += 8 + size


def read_meta(path: Path) -> dict[str, Any]:
    """Return the few arrays that are needed of a -meta.mat file."""
    content = read_bytes(path, _LARGEST_META)
    data = io.BytesIO(content)
    try:
        _check_packed(content)
        meta = scipy.io.loadmat(data, variable_names=_KEYS)
    except NotImplementedError as error:  # of version 7.3, which is HDF5
        raise BadData(path, "a MATLAB file of version 7.3", "save it with -v7") from error
    except Exception as error:  # the file decides what breaks: the parser raises anything
        raise BadData(path, "not readable as a MATLAB file", f"truncated? {error}") from error
    for key in _KEYS:
        if key not in meta:
            raise BadData(path, f"missing key '{key}'")
    return meta
