"""Read TensorBoard's event files: scalars as curves, and the latest picture of each tag."""

import logging
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tensorboard.backend.event_processing.event_accumulator import IMAGES, SCALARS, EventAccumulator

from posefilter.errors import UserError
from posefilter.limits import MOST_BYTES
from posefilter.metrics.registry import rename_key
from posefilter.report.images import StoredImage


class Curve(NamedTuple):
    """One scalar over a run; the three are as long as each other."""

    steps: tuple[int, ...]
    values: tuple[float, ...]
    times: tuple[float, ...]  # [s] since the epoch, when it was logged


def read_events(folder: Path) -> tuple[dict[str, Curve], list[StoredImage]]:
    """Return the scalars by tag and the latest picture of each tag; both empty where nothing was
    logged.

    A file that is still being written is read as far as it goes; steps that a resumed run took
    again count once.
    """
    files = list(find_event_files(folder))
    if not files:
        return {}, []
    for file in files:
        check_records(file)
    # it warns of every step that was taken again
    logging.getLogger("tensorboard").setLevel(logging.ERROR)
    log = EventAccumulator(str(folder), size_guidance={SCALARS: 0, IMAGES: 1})
    log.Reload()
    tags = log.Tags()
    logged: dict[str, list[tuple[int, float, float]]] = {}
    for tag in tags["scalars"]:
        # a run that a later version resumed has both names
        own = logged.setdefault(rename_key(tag), [])
        own += [(e.step, e.value, e.wall_time) for e in log.Scalars(tag)]
    curves = rename_losses({tag: drop_repeats(own) for tag, own in logged.items()})
    pictures = []
    for tag in tags["images"]:
        latest = log.Images(tag)[-1]
        pictures.append(StoredImage(tag, f"{tag}, step {latest.step}", latest.encoded_image_string))
    return curves, pictures


def check_records(path: Path) -> None:
    """Raise UserError where an event file is no file, which its reader would wait for, or where a
    record of it claims more bytes than one has: its reader makes room for them first.
    """
    if not path.is_file():
        raise UserError(f"{path}: is no event file")
    size = path.stat().st_size
    with path.open("rb") as file:
        # a record: its length, a checksum of that, as many bytes, a checksum of those
        while len(head := file.read(12)) == 12:
            length = int.from_bytes(head[:8], "little")
            if length > MOST_BYTES:
                raise UserError(f"{path}: is no event file (a record of {length:,} bytes)")
            if file.tell() + length + 4 > size:  # still being written
                return
            file.seek(length + 4, 1)


def rename_losses(curves: dict[str, Curve]) -> dict[str, Curve]:
    """Return curves whose losses have today's names.

    Earlier runs logged the sum as `train/total` and its terms as `train/<name>`.
    """
    if "train/total" not in curves or any(tag.startswith("train/loss_") for tag in curves):
        return curves
    out = {}
    for tag, curve in curves.items():
        name = tag.removeprefix("train/")
        if name == "total":
            out["train/loss"] = curve
        elif name == tag or name == "learning_rate" or name.endswith("_mm"):
            out[tag] = curve
        else:
            out[f"train/loss_{'main' if name == 'loss' else name}"] = curve
    return out


def drop_repeats(events: list[tuple[int, float, float]]) -> Curve:
    """Return a curve of (step, value, time) in which steps only grow: what was logged last of a
    step is what counts.

    A run that goes on from a checkpoint goes back to its step; what it had logged beyond that is
    void.
    """
    kept: list[tuple[int, float, float]] = []
    for event in sorted(events, key=lambda event: event[2]):
        while kept and kept[-1][0] >= event[0]:
            kept.pop()
        kept.append(event)
    steps, values, times = zip(*kept, strict=True)
    return Curve(steps, values, times)


def find_event_files(folder: Path) -> Iterator[Path]:
    """Return what TensorBoard takes for event files of a run."""
    return folder.glob("*tfevents*")


def list_starts(folder: Path) -> list[float]:
    """Return when each event file was begun [s], as its name has it."""
    found = (re.search(r"tfevents\.(\d{9,12})\b", path.name) for path in find_event_files(folder))
    return sorted(float(one[1]) for one in found if one)


def select_unsaved(pictures: list[StoredImage], files: list[StoredImage]) -> list[StoredImage]:
    """Return the logged pictures that no file shows: `3_belief/belief` is what
    `validation_belief.jpg` is.
    """
    known = {name_figure(picture.name) for picture in files}
    return [picture for picture in pictures if name_figure(picture.name) not in known]


def name_figure(name: str) -> str:
    """Return what a file or tag shows: `belief` of `3_belief/belief`, `test_worst` of
    `6_test/worst`.
    """
    if "/" in name:
        group, _, name = name.rpartition("/")
        return f"test_{name}" if group.endswith("_test") else name
    return name.removeprefix("validation_")
