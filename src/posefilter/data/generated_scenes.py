"""Make sure that the scenes which the project renders itself are there."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from posefilter.errors import UserError

_MARK = "_generator.json"


def ensure_scenes(root: Path, generate: Callable[[Path], Any] | None) -> None:
    """Call `generate(root)` where scenes are missing, or rendering them was cut short.

    Raises UserError without it.
    """
    if _complete(root):
        return
    if generate is None:
        raise UserError(
            f"{root}: no scenes here (data.root); render some with: python generate.py out={root}"
        )
    generate(root)


def _complete(root: Path) -> bool:
    """Tell whether the folder holds scenes, and as many frames as its generator was to make."""
    if not root.is_dir():
        return False
    frames = sum(1 for _ in root.rglob("*.left.json"))
    if frames == 0 or not (root / _MARK).is_file():
        return frames > 0
    try:
        wanted = int(json.loads((root / _MARK).read_text())["frames"])
    except (json.JSONDecodeError, KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{root / _MARK}: not a generator's record ({error}); delete the folder to render it "
            f"anew"
        ) from error
    return frames >= wanted
