"""Images of a dataset in which an object is not: where a filter must not find it."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import cycle

import torch

from posefilter.data.frames import FrameRecord
from posefilter.data.splits import ImageKey, image_key
from posefilter.types import Batch


def find_absent(
    records: Sequence[FrameRecord],
    own: Sequence[FrameRecord],
    name: str,
    unlisted: Collection[tuple[str, str]] = (),
) -> list[FrameRecord]:
    """Return one record of each image in which an object is not listed, its class "".

    Args:
        records: Of all classes of a dataset.
        own: Those of the object.
        name: The object's class.
        unlisted: Images that show a class although no record says so, with the class.
    """
    showing = {record.name for record in own}
    showing |= {record.name for record in records if record.object == name}
    showing |= {image for image, shown in unlisted if shown == name}
    found: dict[str, FrameRecord] = {}
    for record in records:
        if record.name not in showing:
            found.setdefault(record.name, replace(record, object=""))
    return list(found.values())


def deal_images(
    found: Sequence[FrameRecord], parts: Mapping[str, Sequence[FrameRecord]], split: str
) -> list[FrameRecord]:
    """Return those of the images without an object that are of a split: those of its scenes, and
    its part of the scenes that no split has.

    Of a scene that was cut by images, each split has a stretch as long as its share, so that no two
    splits have the same. Stereo pairs stay together, also where one of the two shows the object.

    Args:
        found: One record of each image in which the object is not.
        parts: The object's records in each split.
        split: The images' split.
    """
    # parts have the same records, where one stands for the other, or none in common
    by_first = {records[0].key: part for part, records in parts.items() if records}
    owners = {image_key(record): part for part in by_first.values() for record in parts[part]}
    own = by_first[parts[split][0].key] if parts[split] else None
    scenes: dict[str, set[ImageKey]] = {}
    for record in found:
        scenes.setdefault(record.group, set()).add(image_key(record))
    # in the order in which scenes were cut
    apart = sorted(by_first.values(), key=lambda part: min(map(image_key, parts[part])))
    counts = {part: Counter(record.group for record in parts[part]) for part in apart}
    taken = set().union(*counts.values())
    dealt = _deal_free(sorted(scenes.keys() - taken), counts, own)
    kept = {image for image, part in owners.items() if part == own}
    for scene, images in scenes.items():
        shares = dealt.get(scene, {part: counts[part][scene] for part in apart})
        kept.update(_take_stretch(sorted(images - owners.keys()), shares, own))
    return [record for record in found if image_key(record) in kept]


def _deal_free(
    scenes: Sequence[str], counts: Mapping[str, Mapping[str, int]], split: str | None
) -> dict[str, dict[str | None, int]]:
    """Return the splits' shares of each of the scenes that none has.

    Where validation and test have images, each gets every other scene, so that what a calibration
    saw is not tested on; one scene alone is cut where others were. Else a split gets all.

    Args:
        scenes: In their order.
        counts: The images of each scene that a split has.
        split: One of those that have images, or None.
    """
    held = [part for part in ("val", "test") if part in counts]
    if split not in held or len(held) < 2:
        return {scene: {split: 1} for scene in scenes}
    cut = len(set().union(*counts.values())) < sum(map(len, counts.values()))
    if cut and len(scenes) == 1:
        return {scenes[0]: dict.fromkeys(held, 1)}
    return {scene: {part: 1} for scene, part in zip(scenes, cycle(held))}


def _take_stretch(
    images: Sequence[ImageKey], shares: Mapping[str | None, int], split: str | None
) -> Sequence[ImageKey]:
    """Return a split's images of a scene, whose splits follow each other.

    Args:
        images: In their order.
        shares: Of the splits, not all 0.
        split: Whose images; it may have no share.
    """
    if split not in shares:
        return []
    sizes, at = [*shares.values()], [*shares].index(split)
    first, last = (round(len(images) * sum(sizes[:k]) / sum(sizes)) for k in (at, at + 1))
    return images[first:last]


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
