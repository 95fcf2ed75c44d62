"""Gather what a run's folder holds; what it lacks is written down rather than fatal."""

import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from posefilter import limits
from posefilter.errors import UserError, printable
from posefilter.forms import NUMBER, TEXT, Each, Record, check_form, parse_json
from posefilter.metrics.image_errors import FILE, ImageError
from posefilter.report.events import (
    Curve,
    find_event_files,
    list_starts,
    read_events,
    select_unsaved,
)
from posefilter.report.image_errors import read_image_errors
from posefilter.report.images import StoredImage, read_images

MARKS = ("metrics.json", ".hydra/config.yaml")
_MOST_JSON = 1 << 26  # [bytes]
SWEEP_MARKS = ("multirun.yaml", "summary.csv")
_NO_ERRORS = "No errors.csv: what the test found in single images is not known."

# what pages compute with, and follow into
_QUARTER = {"from": NUMBER, "to": NUMBER, "instances": NUMBER, "coverage": [NUMBER]}
_BIN = dict.fromkeys(("from", "to", "frames", "probability", "right"), NUMBER)
_DATA = {"objects": [TEXT], "splits": Each({})}
_METRICS = {
    "instances": NUMBER,
    "missed": NUMBER,
    "by_visibility": Each(Record({"instances": NUMBER})),
    "confidence": {"bins": [Record(_BIN)]},
    "credibility": {"levels": [NUMBER], "all": [NUMBER], "quarters": [Record(_QUARTER)]},
    "data": _DATA,
    "diagnostics": {},
    "versions": {},
}
_SETTINGS: dict[str, Any] = {"data": {}, "trainer": {}}


@dataclass(frozen=True)
class Run:
    """What is known of one run."""

    folder: Path
    metrics: dict[str, Any]  # metrics.json; empty before the test
    # of its training, where an evaluation has since written its own; else empty
    metrics_train: dict[str, Any]
    config: dict[str, Any]  # as composed, interpolations unresolved
    choices: dict[str, str]  # which file of each group
    overrides: list[str]  # as typed
    data: dict[str, Any]  # data.json
    curves: dict[str, Curve]
    pictures: list[StoredImage]
    errors: list[ImageError]  # of each image of its test
    missing: list[str] = field(default_factory=list)  # a sentence each
    starts: list[float] = field(default_factory=list)  # of its event files [s]

    def named(self, key: str) -> str:
        """Return the run's model, loss or variant; "?" where nothing tells it."""
        return str(self.metrics.get(key) or self.choices.get(key) or "?")


def read_run(folder: Path) -> Run:
    """Read a run's folder.

    Raises UserError where it is none, or holds a file that cannot be read.
    """
    check_run(folder)
    metrics = read_metrics(folder / "metrics.json")
    config = read_yaml(folder / ".hydra" / "config.yaml")
    check_form(config, _SETTINGS, folder / ".hydra" / "config.yaml")
    hydra = read_yaml(folder / ".hydra" / "hydra.yaml")
    data = read_json(folder / "data.json")
    check_form(data, _DATA, folder / "data.json")
    said = folder / ".hydra" / "hydra.yaml"
    chosen = read_part(hydra, ("hydra", "runtime", "choices"), said)
    choices = {str(k): str(v) for k, v in chosen.items() if v is not None}
    typed = read_part(hydra, ("hydra", "overrides"), said)
    curves, logged = read_events(folder)
    files = read_images(folder / "figures")
    evaluation = bool(metrics.get("checkpoint")) and not config  # no training's folder
    return Run(
        folder=folder,
        metrics=metrics,
        metrics_train=read_metrics(folder / "metrics_train.json"),
        config=config,
        choices=choices,
        overrides=[
            one.removeprefix("++")  # which `++` the command put there
            for one in read_texts(typed, "task", said)
            or read_texts(metrics, "overrides", folder / "metrics.json")
        ],
        data=data,
        curves=curves,
        pictures=[*files, *select_unsaved(logged, files)],
        errors=read_image_errors(folder),
        missing=list_missing(folder, bool(files or logged), evaluation),
        starts=list_starts(folder),
    )


def check_run(folder: Path) -> None:
    """Raise UserError unless a folder is a run's."""
    if not folder.is_dir():
        raise UserError(f"run={folder}: no such folder")
    if (folder / "tracks.csv").is_file():
        raise UserError(f"run={folder}: holds tracks of track.py, of which there is no report")
    if any((folder / mark).is_file() for mark in MARKS) or any(find_event_files(folder)):
        return
    if any((folder / mark).is_file() for mark in SWEEP_MARKS):
        given = shlex.quote(f"sweep={folder}")
        raise UserError(f"run={folder}: is a sweep's folder; give it as {given}")
    raise UserError(
        f"run={folder}: is no run's folder (it has no metrics.json, no "
        f".hydra/config.yaml and no events)"
    )


def list_missing(folder: Path, pictures: bool, evaluation: bool) -> list[str]:
    """Return what a run's folder lacks, and what that means."""

    def lacks(name: str) -> bool:
        return not (folder / name).is_file()

    if evaluation:
        said = "An evaluation: how its checkpoint was trained is told by the run that wrote it."
        return [said, *([_NO_ERRORS] if lacks(FILE) else [])]
    events = any(find_event_files(folder))
    sentences = {
        "No metrics.json: the run has not been tested.": lacks("metrics.json"),
        _NO_ERRORS: lacks(FILE) and not lacks("metrics.json"),
        "No TensorBoard events, so no curves and no timings of the training.": not events,
        "No pictures in figures/ or in the events, so no gallery.": not pictures,
        "No .hydra folder: what was configured is not known.": lacks(".hydra/config.yaml"),
        "No data.json: how its data were split is not known.": lacks("data.json"),
    }
    return [sentence for sentence, true in sentences.items() if true]


def read_metrics(path: Path) -> dict[str, Any]:
    """Return what a test found, empty where there is no file.

    Raises UserError where it is malformed, or has other parts than a page can be made of.
    """
    metrics = read_json(path)
    check_form(metrics, _METRICS, path)
    ends = r"\d+(\.\d+)?"
    for name in metrics.get("by_visibility") or {}:
        if not re.fullmatch(f"{ends}-{ends}", name):
            said = f"its by_visibility should have ranges, as 0.3-0.5: {printable(name[:40])}"
            raise UserError(f"{path}: {said}")
    found = metrics.get("credibility") or {}
    curves = [found.get("all"), *(one["coverage"] for one in found.get("quarters") or ())]
    levels = found.get("levels")
    if levels and any(curve is None or len(curve) != len(levels) for curve in curves):
        raise UserError(f"{path}: its credibility should have a share for each of its levels")
    return metrics


def read_json(path: Path) -> dict[str, Any]:
    """Return a JSON file's object, empty where there is no file.

    Raises UserError where it is malformed.
    """
    if not path.is_file():
        return {}
    content = limits.read_json(path, _MOST_JSON, parse_json)
    if not isinstance(content, dict):
        raise UserError(f"{path}: should hold one JSON object")
    return content


def read_part(content: dict[str, Any], keys: Sequence[str], path: Path) -> dict[str, Any]:
    """Return a mapping within a file's content, empty where there is none.

    Args:
        content: The file's.
        keys: Each within the one before.
        path: The file, for messages.

    Raises:
        UserError: Something else is there.
    """
    for key in keys:
        content = content.get(key) or {}
        if not isinstance(content, dict):
            raise UserError(f"{path}: its {key} should be a mapping")
    return content


def read_texts(content: dict[str, Any], key: str, path: Path) -> list[str]:
    """Return a list within a file's content as texts, empty where there is none.

    Raises UserError where something else is there.
    """
    found = content.get(key) or []
    if not isinstance(found, list):
        raise UserError(f"{path}: its {key} should be a list")
    return [str(one) for one in found]


def read_yaml(path: Path) -> dict[str, Any]:
    """Return a YAML file's mapping, empty where there is no file.

    Raises UserError where it is malformed, larger than settings are, or has aliases.
    """
    if not path.is_file():
        return {}
    content = limits.read_yaml(path)
    if not isinstance(content, dict):
        raise UserError(f"{path}: should hold one mapping")
    return content
