"""Make sure that the scenes which the project renders itself are there."""

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

from posefilter.errors import BadData, UserError
from posefilter.limits import read_json

_MARK = "_generator.json"


def ensure_scenes(root: Path, generate: Callable[[Path], Any] | None) -> None:
    """Render scenes where they are missing, or where rendering them was cut short.

    Args:
        root: The dataset's folder.
        generate: Renders into a folder; None where nothing is to be rendered, as in evaluations.

    Raises:
        UserError: Scenes are missing, and there is no `generate`.
    """
    there, wanted = _count(root)
    if 0 < wanted <= there:
        return
    if generate is not None:
        generate(root)
        return
    state = f"only {there} of {wanted} scenes' frames are here" if there else "no scenes here"
    raise UserError(
        f"{root}: {state} (data.root); is the folder mistyped? Nothing is rendered unless asked: "
        f"by data.generate.frames=N, or: python generate.py {shlex.quote(f'out={root}')}"
    )


def count_frames(root: Path) -> int:
    """Return how many frames a folder holds."""
    return sum(1 for _ in root.rglob("*.left.json"))


def _count(root: Path) -> tuple[int, int]:
    """Return how many frames a folder holds, and how many its generator was to make, if any did."""
    if not root.is_dir():
        return 0, 0
    frames = count_frames(root)
    if frames == 0 or not (root / _MARK).is_file():
        return frames, frames
    try:
        return frames, int(read_json(root / _MARK)["frames"])
    except (BadData, KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(
            f"{root / _MARK}: not a generator's record ({error}); delete the folder to render it "
            f"anew"
        ) from error
