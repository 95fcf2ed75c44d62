"""What an estimator is to find: BOP's `test_targets_bop19.json`, a list of `{"scene_id", "im_id",
"obj_id", "inst_count"}`.
"""

from pathlib import Path
from typing import Any, NamedTuple

from posefilter.errors import UserError
from posefilter.limits import read_json
from posefilter.paths import find_list

_KEYS = ("scene_id", "im_id", "obj_id", "inst_count")


class Target(NamedTuple):
    """Instances of one class in one image that are to be found."""

    scene_id: int
    im_id: int
    obj_id: int
    inst_count: int


def read_targets(file: str, root: Path) -> tuple[Path, list[Target]]:
    """Read a file of targets, which is also looked for in the dataset's folder and beside it.

    Args:
        file: Its path, or its name in the dataset.
        root: The dataset's folder, or that of a split.

    Returns:
        Where it was found, and what it lists.

    Raises:
        UserError: There is none, or it holds something else; the message names the entry.
    """
    path = find_list(file, root)
    if path is None:
        raise UserError(f"targets={file}: no such file, nor in data.root={root}")
    content = read_json(path)
    if not isinstance(content, list):
        raise UserError(
            f"targets={path}: expected a list of targets, got a {type(content).__name__}"
        )
    targets = [_read_one(one, f"targets={path}, entry {i}") for i, one in enumerate(content)]
    if len({one[:3] for one in targets}) < len(targets):
        raise UserError(f"targets={path}: names a class of an image twice")
    return path, targets


def _read_one(one: Any, where: str) -> Target:
    if isinstance(one, dict) and "im_id" in one and "obj_id" not in one:
        raise UserError(
            f"{where}: names an image and no object, as lists for detection do; to score poses "
            "give test_targets_bop19.json, or targets=all"
        )
    if not isinstance(one, dict) or not all(type(one.get(key)) is int for key in _KEYS):
        raise UserError(f"{where}: {', '.join(_KEYS)} should be whole numbers")
    if one["inst_count"] < 1:
        raise UserError(f"{where}: inst_count={one['inst_count']} should be 1 or more")
    return Target(*(one[key] for key in _KEYS))
