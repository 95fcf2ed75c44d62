"""Divide a dataset into training, validation and test frames by scene, once and for all, before
anything is learned.
"""

import fnmatch
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from posefilter.data.frames import FrameRecord
from posefilter.errors import UserError

NAMES = ("train", "val", "test")
Share = float | str | Sequence[str]  # of the scenes; a file that lists frames; scenes by name


def split_records(
    records: Sequence[FrameRecord], split: Mapping[str, Share | None], seed: int, root: Path
) -> dict[str, list[int]]:
    """Return the indices of each split's records.

    A share is a fraction of the scenes, a list of scene names (* and ? allowed), a file of frames
    (`0048/000001` a line, or BOP's targets as JSON), or another part's name: the same frames again,
    as a test of memory wants. Fractions divide the scenes that neither lists nor files took,
    shuffled by the seed. Raises UserError where names are unknown, fractions exceed one, or scenes
    are too few.
    """
    unknown = sorted(set(split) - set(NAMES))
    if unknown:
        raise UserError(f"data.split: unknown part '{unknown[0]}'; there are {', '.join(NAMES)}")
    out: dict[str, list[int]] = {name: [] for name in NAMES}
    taken: dict[str, str] = {}  # scene -> split
    for name, share in split.items():
        if share is None or isinstance(share, int | float) or share in NAMES:
            continue
        chosen = (
            _listed(records, share, root)
            if isinstance(share, str)
            else _named(records, list(share), name)
        )
        for scene in {records[i].group for i in chosen}:
            if taken.setdefault(scene, name) != name:
                raise UserError(
                    f"data.split: scene '{scene}' is in both '{taken[scene]}' and '{name}'"
                )
        out[name] = chosen
    fractions = {
        name: float(share)
        for name, share in split.items()
        if isinstance(share, int | float) and share > 0
    }
    scenes = sorted({record.group for record in records} - set(taken))
    owner = _divide(scenes, fractions, seed)
    for i, record in enumerate(records):
        if record.group in owner:
            out[owner[record.group]].append(i)
    for name, share in split.items():
        if isinstance(share, str) and share in NAMES:
            out[name] = out[share]
    return out


def _divide(scenes: list[str], fractions: Mapping[str, float], seed: int) -> dict[str, str]:
    """Return the split of each scene: every fraction gets one scene at least."""
    total = sum(fractions.values())
    if total > 1 + 1e-6 or any(f < 0 for f in fractions.values()):
        raise UserError(
            f"data.split: fractions {dict(fractions)} must be positive and sum to 1 at most"
        )
    if len(scenes) < len(fractions):
        raise UserError(
            f"data.split: {len(scenes)} scenes cannot be divided into {', '.join(fractions)}: a "
            f"scene is never cut; "
            "use more scenes, or name one part, such as split={test: 1.0}"
        )
    order = [scenes[i] for i in np.random.default_rng([seed, 7]).permutation(len(scenes))]
    counts = {name: max(1, round(fraction * len(scenes))) for name, fraction in fractions.items()}
    while counts and sum(counts.values()) > len(scenes):
        counts[max(counts, key=lambda name: counts[name])] -= 1
    # rounding leaves no scene unused where the fractions are to use all
    if counts and total > 1 - 1e-6:
        counts[max(fractions, key=lambda name: fractions[name])] += len(scenes) - sum(
            counts.values()
        )
    owner, at = {}, 0
    # test first: more scenes later leave it alone for longest
    for name in (name for name in NAMES[::-1] if name in counts):
        owner.update(dict.fromkeys(order[at : at + counts[name]], name))
        at += counts[name]
    return owner


def _named(records: Sequence[FrameRecord], patterns: list[str], part: str) -> list[int]:
    scenes = {record.group for record in records}
    for pattern in patterns:
        if not fnmatch.filter(scenes, str(pattern)):
            some = ", ".join(sorted(scenes)[:6])
            raise UserError(
                f"data.split.{part}: no scene '{pattern}'; there are {len(scenes)}: {some}, ..."
            )
    return [
        i
        for i, record in enumerate(records)
        if any(fnmatch.fnmatch(record.group, str(p)) for p in patterns)
    ]


def _listed(records: Sequence[FrameRecord], file: str, root: Path) -> list[int]:
    """Return the records that a file lists."""
    candidates = [
        Path(file),
        root / file,
        root / "image_sets" / file,
        root.parent / file,
        root.parent / "image_sets" / file,
    ]
    path = next((p for p in candidates if p.is_file()), None)
    if path is None:
        raise UserError(f"data.split: no such list of frames: {file} (nor below {root})")
    if path.suffix == ".json":
        targets = {
            (int(t["scene_id"]), int(t["im_id"]), int(t["obj_id"])) for t in _json_list(path)
        }
        chosen = [i for i, r in enumerate(records) if (r.scene_id, r.im_id, r.obj_id) in targets]
    else:
        lines = {line.strip() for line in path.read_text().splitlines() if line.strip()}
        chosen = [i for i, r in enumerate(records) if r.name in lines]
    if not chosen:
        raise UserError(
            f"{path}: none of the frames that it lists is in {root} with the object asked for"
        )
    return chosen


def _json_list(path: Path) -> list[dict[str, Any]]:
    try:
        content = json.loads(path.read_text())
        return [t for t in content if {"scene_id", "im_id", "obj_id"} <= set(t)]
    except (json.JSONDecodeError, TypeError) as error:
        raise UserError(f"{path}: not a list of BOP targets ({error})") from error
