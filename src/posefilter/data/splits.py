"""Divide a dataset into training, validation and test frames by scene, once and for all, before
anything is learned.
"""

import fnmatch
import logging
from collections.abc import Hashable, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from posefilter.data.frames import FrameRecord
from posefilter.errors import UserError
from posefilter.limits import read_json, read_lines
from posefilter.paths import find_list

log = logging.getLogger(__name__)

NAMES = ("train", "val", "test")
_Thing = TypeVar("_Thing", bound=Hashable)
ImageKey = tuple[str, int]  # the scene and the number of an image, see `image_key`
Share = float | str | Sequence[str]  # of the scenes; a file that lists frames; scenes by name


def split_records(
    records: Sequence[FrameRecord], split: Mapping[str, Share | None], seed: int, root: Path
) -> dict[str, list[int]]:
    """Divide records into training, validation and test.

    A share is a fraction of the scenes, a list of scene names (* and ? allowed), a file of frames
    (`0048/000001` a line, or BOP's targets as JSON), or another part's name: the same frames again,
    as a test of memory wants. Fractions divide the scenes that neither lists nor files took,
    shuffled by the seed. Where there are fewer scenes than fractions, images are divided instead,
    in blocks of neighbors, with a warning.

    Args:
        records: The records of the dataset.
        split: The share of each part; a part without one gets nothing.
        seed: Shuffles the scenes.
        root: The dataset's folder, where lists of frames are looked for.

    Returns:
        The indices of each part's records, in the dataset's order.

    Raises:
        UserError: Names are unknown, fractions exceed one, or there are fewer images than parts.
    """
    unknown = sorted(set(split) - set(NAMES))
    if unknown:
        raise UserError(f"data.split: unknown part '{unknown[0]}'; there are {', '.join(NAMES)}")
    out: dict[str, list[int]] = {name: [] for name in NAMES}
    taken: dict[str, str] = {}  # scene -> split
    for name, share in split.items():
        if isinstance(share, bool) or (isinstance(share, Sequence) and not len(share)):
            raise UserError(
                f"data.split.{name}={share}: a share from 0 to 1, scenes, a file of them, "
                "or another part"
            )
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
        if isinstance(share, int | float) and not isinstance(share, bool) and share != 0
    }
    scenes = sorted({record.group for record in records} - set(taken))
    if not all(0 < share <= 1 for share in fractions.values()) or (
        sum(fractions.values()) > 1 + 1e-6
    ):
        raise UserError(f"data.split: fractions {fractions} must be positive and sum to 1 at most")
    owner: dict[Any, str]
    if len(scenes) >= len(fractions):
        order = np.random.default_rng([seed, 7]).permutation(len(scenes))
        owner = _deal([scenes[i] for i in order], fractions, NAMES[::-1])
        left = [(i, owner.get(record.group)) for i, record in enumerate(records)]
    else:
        owner = _divide_images(records, set(scenes), fractions, root)
        left = [(i, owner.get(image_key(record))) for i, record in enumerate(records)]
    for i, part in left:
        if part is not None:
            out[part].append(i)
    for name in split:
        out[name] = out[_follow(name, split)]
    return out


def image_key(record: FrameRecord) -> ImageKey:
    """Return what the records of one image have in common, those of a stereo pair too."""
    return record.group, record.im_id


def find_learned(
    before: Mapping[str, Mapping[str, int]],
    after: Mapping[str, Mapping[str, int]],
    part: str = "test",
) -> list[str]:
    """Return the scenes that a division would test or calibrate on, and an earlier one learned from
    without having them in that part: where scenes came or went, others are shuffled. A test is of
    scenes that no checkpoint was chosen by either.

    Args:
        before: Scenes of each part, as a training had them.
        after: Scenes of each part now.
        part: `test` or `val`.
    """
    learned = {*before.get("train", {})}
    if part == "test":
        learned |= {*before.get("val", {})}
    return sorted((learned - {*before.get(part, {})}) & {*after.get(part, {})})


def _follow(name: str, split: Mapping[str, Share | None]) -> str:
    """Return the part whose frames a part has: itself, or the one that it names, and so on.

    Raises UserError where parts name each other.
    """
    passed = [name]
    while isinstance(share := split.get(passed[-1]), str) and share in NAMES:
        if share in passed:
            raise UserError(f"data.split: {' and '.join(passed)} name each other, and no frames")
        passed.append(share)
    return passed[-1]


def _divide_images(
    records: Sequence[FrameRecord], scenes: set[str], fractions: Mapping[str, float], root: Path
) -> dict[ImageKey, str]:
    """Return the split of each image: blocks of neighbors, since neighbors are alike."""
    images = sorted({image_key(record) for record in records if record.group in scenes})
    parts = ", ".join(fractions)
    if not records:
        raise UserError(f"data.root: no frames in {root}")
    if not images:
        raise UserError(
            f"data.split: nothing is left for {parts}, since lists name all scenes; a list alone "
            "is typed in braces, such as 'data.split={test: FILE}'"
        )
    if len(images) < len(fractions):
        raise UserError(
            f"data.split: {len(images)} images in {root} cannot be divided into {parts}; use more, "
            "or name one part, such as 'data.split={test: 1.0}'"
        )
    log.warning(
        "data.split: %d scene%s in %s cannot be divided into %s: split by frames instead; frames "
        "of one scene are alike, so scores will flatter",
        len(scenes),
        "" if len(scenes) == 1 else "s",
        root,
        parts,
    )
    return _deal(images, fractions, NAMES)


def _deal(
    things: Sequence[_Thing], fractions: Mapping[str, float], names: Sequence[str]
) -> dict[_Thing, str]:
    """Return the split of each thing: in their order, the first name's share first; every fraction
    gets one thing at least.
    """
    counts, left = _counts(len(things), fractions), iter(things)
    return {thing: name for name in names for thing in islice(left, counts.get(name, 0))}


def _counts(many: int, fractions: Mapping[str, float]) -> dict[str, int]:
    """Return how many of `many` things each fraction gets, one at least."""
    counts = {name: max(1, round(fraction * many)) for name, fraction in fractions.items()}
    while counts and sum(counts.values()) > many:
        counts[max(counts, key=lambda name: counts[name])] -= 1
    # rounding leaves nothing unused where the fractions are to use all
    if counts and sum(fractions.values()) > 1 - 1e-6:
        counts[max(fractions, key=lambda name: fractions[name])] += many - sum(counts.values())
    return counts


def _named(records: Sequence[FrameRecord], patterns: list[str], part: str) -> list[int]:
    scenes = {record.group for record in records}
    chosen = set[str]()
    for pattern in patterns:
        found = fnmatch.filter(scenes, str(pattern))
        if not found:
            some = ", ".join(sorted(scenes)[:6])
            raise UserError(
                f"data.split.{part}: no scene '{pattern}'; there are {len(scenes)}: {some}, ..."
            )
        chosen.update(found)
    return [i for i, record in enumerate(records) if record.group in chosen]


def _listed(records: Sequence[FrameRecord], file: str, root: Path) -> list[int]:
    """Return the records that a file lists."""
    path = find_list(file, root)
    if path is None:
        raise UserError(f"data.split: no such list of frames: {file} (nor below {root})")
    if path.suffix == ".json":
        targets = set(_json_list(path))
        chosen = [
            i
            for i, r in enumerate(records)
            if not targets.isdisjoint({(r.scene_id, r.im_id, r.obj_id), (r.scene_id, r.im_id)})
        ]
        listed = {str(scene) for scene, *_ in targets}
        seen = {str(records[i].scene_id) for i in chosen}
        folders = (one.name for one in (*root.glob("*/"), *root.glob("*/*/")))
        there = {str(int(name)) for name in folders if name.isdecimal()}
    else:
        lines = set(read_lines(path))
        chosen = [i for i, r in enumerate(records) if r.name in lines]
        listed = {line.rpartition("/")[0] for line in lines}
        seen = {records[i].name.rpartition("/")[0] for i in chosen}
        homes = (root, *root.glob("*/"))
        there = {one for one in listed if any((home / one).is_dir() for home in homes)}
    if not chosen:
        raise UserError(
            f"{path}: none of the frames that it lists is in {root} with the object asked for "
            "(of an evaluation data.object=null takes all objects)"
        )
    missing = sorted(listed - there - seen)
    if missing and seen & there:  # elsewhere scenes are no folders, or are numbered otherwise
        log.warning(
            "data.split: %d of the %d scenes in %s are not in %s, and are left out: %s",
            len(missing),
            len(listed),
            path,
            root,
            ", ".join(missing[:6]) + (", ..." if len(missing) > 6 else ""),
        )
    return chosen


def _json_list(path: Path) -> list[tuple[int, ...]]:
    """Return (scene_id, im_id, obj_id) of BOP's targets, or (scene_id, im_id) where a list for
    detection names no object.
    """
    content = read_json(path)
    try:
        return [
            tuple(int(t[key]) for key in ("scene_id", "im_id", "obj_id")[: 2 + ("obj_id" in t)])
            for t in content
        ]
    except (KeyError, ValueError, TypeError, OverflowError) as error:
        raise UserError(f"{path}: not a list of BOP targets ({error})") from error
