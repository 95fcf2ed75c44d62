"""Files of the YCB-Video dataset: class names, scenes, lists of frames, meta data."""

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import scipy.io

from posefilter.data.readers.decode import (
    list_folder,
)
from posefilter.errors import BadData, UserError
from posefilter.limits import read_bytes, read_lines
from posefilter.meshes import ycb
from posefilter.paths import is_plain_name

FRAME = re.compile(r"[0-9]{1,9}")


_KEYS = ["cls_indexes", "poses", "factor_depth", "intrinsic_matrix"]


# bytes of a -meta.mat, of which there may be 2 MB, and of a list
_LARGEST_META = 1 << 25


_LONGEST_LIST = 1 << 22


# rendered frames have no scenes: blocks stand in, numbered from here
SYNTHETIC = "data_syn"


def read_class_names(root: Path) -> tuple[str, ...]:
    for path in (
        root / "image_sets" / "classes.txt",
        root / "classes.txt",
        root.parent / "classes.txt",
    ):
        if path.is_file():
            names = tuple(read_lines(path, _LONGEST_LIST))
            wrong = [name for name in names if not is_plain_name(name)]
            if wrong:
                raise UserError(f"{path}: class with an impossible name {wrong[0][:40]!r}")
            return names
    return ycb.CLASSES


def list_scenes(root: Path, parts: set[str]) -> Iterator[tuple[str, Path]]:
    """Yield scenes by name: those of `data` by number, `data_syn` as one."""
    if list_stems(root):
        yield (SYNTHETIC if root.name == SYNTHETIC else root.name), root
        return
    if SYNTHETIC in parts and (root / SYNTHETIC).is_dir():
        yield SYNTHETIC, root / SYNTHETIC
    data = root / "data" if (root / "data").is_dir() else root
    if "data" in parts:
        for name in list_folder(data):
            if FRAME.fullmatch(name) and (data / name).is_dir():
                yield name, data / name


def list_stems(folder: Path) -> list[str]:
    names = list_folder(folder)
    return [name.removesuffix("-meta.mat") for name in names if name.endswith("-meta.mat")]


def read_frame_list(root: Path, listed: str | Path) -> list[str]:
    candidates = [Path(listed), root / listed, root / "image_sets" / listed, root.parent / listed]
    path = next((p for p in candidates if p.is_file()), None)
    if path is None:
        raise UserError(f"{listed}: no such list of frames (data.options.frames), nor below {root}")
    names = read_lines(path, _LONGEST_LIST)
    if not names or any("/" not in name for name in names):
        raise UserError(f"{path}: not a list of frames; expected lines such as 0048/000001")
    return names


def read_meta(path: Path) -> dict[str, Any]:
    """Return the few arrays that are needed of a -meta.mat file."""
    data = io.BytesIO(read_bytes(path, _LARGEST_META))
    try:
        meta = scipy.io.loadmat(data, variable_names=_KEYS)
    except Exception as error:  # the file decides what breaks: the parser raises anything
        raise BadData(path, "not readable as a MATLAB file", f"truncated? {error}") from error
    for key in _KEYS:
        if key not in meta:
            raise BadData(path, f"missing key '{key}'")
    return meta
