"""Images of a dataset in which an object is not: where a filter must not find it."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence

import torch

from posefilter.data.frames import FrameRecord
from posefilter.types import Batch


def find_absent(
    records: Sequence[FrameRecord],
    own: Sequence[FrameRecord],
    scenes: Mapping[str, Mapping[str, int]],
    split: str,
    name: str,
    unlisted: Collection[tuple[str, str]] = (),
) -> list[FrameRecord]:
    """Return one record of each image in which an object is not listed.

    Scenes in which it is never listed are of no split: where validation and test have scenes, each
    gets every other one of them, so that what a calibration saw is not tested on.

    Args:
        records: Of all classes of a dataset.
        own: Those of the object.
        scenes: The scenes of each split of the object's records, as `split_record` has them.
        split: Images are of its scenes, and of its part of those that no split has.
        name: The object's class.
        unlisted: Images that show a class although no record says so, with the class.
    """
    elsewhere = {scene for part, found in scenes.items() if part != split for scene in found}
    elsewhere -= set(scenes[split])  # a part may stand for another one's scenes
    held = [part for part in ("val", "test") if scenes.get(part)]
    if len(held) == 2 and split in held and set(scenes["val"]) != set(scenes["test"]):
        taken = {scene for found in scenes.values() for scene in found}
        free = sorted({record.group for record in records} - taken)
        elsewhere |= {*free} - {*free[held.index(split) :: 2]}
    showing = {record.name for record in own}
    showing |= {record.name for record in records if record.object == name}
    showing |= {image for image, shown in unlisted if shown == name}
    found: dict[str, FrameRecord] = {}
    for record in records:
        if record.name not in showing and record.group not in elsewhere:
            found.setdefault(record.name, record)
    return list(found.values())


def deal_images(
    found: Sequence[FrameRecord], parts: Mapping[str, Sequence[FrameRecord]], split: str
) -> list[FrameRecord]:
    """Return those of the images that are of a split, where its scenes were cut by images: of each
    scene a stretch as long as the split's share, so that no two splits have the same.

    Args:
        found: One record of each image in which the object is not.
        parts: The object's records in each split, in the order in which scenes were cut.
        split: The images' split.
    """
    own = {record.name for record in parts[split]}
    apart = [  # less parts that stand for this one
        part
        for part, records in parts.items()
        if part == split or own.isdisjoint(record.name for record in records)
    ]
    counts = {part: Counter(record.group for record in parts[part]) for part in apart}
    by_scene: dict[str, list[str]] = {}
    for record in found:
        by_scene.setdefault(record.group, []).append(record.name)
    kept, at = set[str](), apart.index(split)
    for scene, names in by_scene.items():
        sizes = [counts[part][scene] for part in apart]
        if not any(sizes):  # of no split, and so not cut
            kept.update(names)
            continue
        first, last = (round(len(names) * sum(sizes[:k]) / sum(sizes)) for k in (at, at + 1))
        kept.update(sorted(names)[first:last])
    return [record for record in found if record.name in kept]


def annotates_one_class(records: Sequence[FrameRecord]) -> bool:
    """Tell whether a dataset of several classes lists one alone in each image, as LINEMOD does,
    whose images show others, too.
    """
    shown: dict[str, set[str]] = {}
    for record in records:
        shown.setdefault(record.name, set()).add(record.object)
    return len(set().union(*shown.values())) > 1 and all(len(own) == 1 for own in shown.values())


def hide_annotation(batch: Batch) -> Batch:
    """Return a batch without mask, pose and visibility: of images without the object, where they
    are another's, and for a method that is tested, which must not see them.
    """
    count = len(batch.rgb)
    return batch._replace(
        mask=torch.zeros_like(batch.mask),
        camera_from_object=torch.eye(4).expand(count, 4, 4).to(batch.camera_from_object),
        visibility=torch.zeros_like(batch.visibility),
    )
