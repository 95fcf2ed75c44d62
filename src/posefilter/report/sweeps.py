"""Gather a sweep: its runs, the settings in which they differ, and runs that differ in nothing but
the seed as one.
"""

import csv
import math
import shlex
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from statistics import mean
from typing import NamedTuple

from posefilter.errors import UserError
from posefilter.forms import MOST
from posefilter.limits import open_text
from posefilter.metrics.results import find_error, score_numbers
from posefilter.report.diagnostics import list_numbers
from posefilter.report.gather import SWEEP_MARKS, read_json, read_part, read_texts, read_yaml
from posefilter.report.settings import SILENT, read_typed

COLUMNS = {  # of summary.csv, and the metrics that they hold
    key.replace("/", "_"): key
    for key in (
        "add/auc", "add/recall_01d", "add/median_mm", "add_s/auc", "add_up_to_symmetry/auc",
        "add_up_to_symmetry/median_mm", "iou", "particles_on_object", "seconds_per_image",
    )
}  # fmt: skip
DETECTING = ("iou", "particles_on_object")  # what the score of a detector is made of
Value = int | float | str


class Job(NamedTuple):
    """One run that ended."""

    place: dict[str, Value]  # its value on each axis
    numbers: dict[str, float]
    folder: str  # within the sweep's
    error: str = ""  # why it has no result


@dataclass(frozen=True)
class Sweep:
    """What is known of a sweep."""

    folder: Path
    axes: list[str]  # swept settings
    jobs: list[Job]
    unfinished: list[str]  # folders of runs without a result
    failed: list[Job] = field(default_factory=list)  # those that say why

    @property
    def shown(self) -> list[str]:
        """Return the axes other than the seed; the seed where there is no other."""
        return [axis for axis in self.axes if axis != "seed"] or self.axes

    def values(self, axis: str) -> list[Value]:
        """Return the values of an axis: numbers by size, else in the order of the jobs."""
        values = list(dict.fromkeys(job.place[axis] for job in self.jobs))
        return values if any(isinstance(one, str) for one in values) else sorted(values)


class Group(NamedTuple):
    """Runs that differ in nothing but the seed."""

    place: dict[str, Value]
    jobs: list[Job]

    def of(self, name: str) -> list[float]:
        """Return a figure of each of its runs that has it."""
        return [job.numbers[name] for job in self.jobs if name in job.numbers]


def read_sweep(folder: Path) -> Sweep:
    """Read a sweep's folder: its runs' metrics, or where they are not there its summary.csv.

    Raises UserError where the folder is no sweep's, or nothing in it has ended.
    """
    if not folder.is_dir():
        raise UserError(f"sweep={folder}: no such folder")
    marks = ("metrics.json", "failed.json")
    known = {path.parent for mark in marks for path in folder.rglob(mark)}
    # less evaluations within a run's folder
    found = sorted(one for one in known - {folder} if known.isdisjoint(one.parents))
    if not found and not any((folder / mark).is_file() for mark in SWEEP_MARKS):
        own = (folder / ".hydra").is_dir()
        given = shlex.quote(f"run={folder}")
        kind = f"is a run's folder; give it as {given}" if own else "is no sweep's folder"
        raise UserError(
            f"sweep={folder}: {kind} (no run with a metrics.json below it, no "
            f"multirun.yaml, no summary.csv)"
        )
    started = sorted(path.parent.parent for path in folder.rglob(".hydra/overrides.yaml"))
    done = {path for path in found if not (path / "failed.json").is_file()}
    unfinished = [str(p.relative_to(folder)) for p in started if p not in {*done, folder}]
    if found:
        axes, jobs = read_jobs(folder, found)
    elif (folder / "summary.csv").is_file():
        axes, jobs = read_jobs_from_csv(folder / "summary.csv")
    else:
        raise UserError(f"sweep={folder}: none of its {len(started)} runs has ended yet")
    keys = [make_sort_key(read_declared(folder).get(axis, [])) for axis in axes]
    jobs.sort(key=lambda job: [key(job.place[axis]) for axis, key in zip(axes, keys, strict=True)])
    ended, failed = ([job for job in jobs if bool(job.error) is bad] for bad in (False, True))
    return Sweep(folder, axes, ended, unfinished, failed)


def read_jobs(folder: Path, found: Sequence[Path]) -> tuple[list[str], list[Job]]:
    """Return the settings in which runs differ, and the runs."""
    # first the run's own test, where an evaluation has since written beside it
    names = ("failed.json", "metrics_train.json", "metrics.json")
    metrics = [next((m for n in names if (m := read_json(p / n))), {}) for p in found]
    overrides = [read_texts(own, "overrides", p) for p, own in zip(found, metrics, strict=True)]
    settings = [read_typed(own) for own in overrides]
    keys = dict.fromkeys(key for pairs in settings for key in pairs)
    declared = read_declared(folder)
    axes = [
        key
        for key in keys
        if (key not in SILENT or len(declared.get(key, [])) > 1)
        and len({pairs.get(key) for pairs in settings}) > 1
    ]
    jobs = []
    for path, own, pairs in zip(found, metrics, settings, strict=True):
        place = {axis: parse_number(pairs.get(axis, "default")) for axis in axes}
        name, error = str(path.relative_to(folder)), str(own.get("error") or "")
        jobs.append(Job(place, list_numbers(own), name, error))
    return axes, jobs


def read_jobs_from_csv(path: Path) -> tuple[list[str], list[Job]]:
    """Return the same of a summary: columns of no known figure are axes."""
    try:
        rows = list(csv.DictReader(open_text(path), restval=""))
    except (csv.Error, ValueError) as error:
        raise UserError(f"{path}: is no table of runs ({error})") from error
    others = (*COLUMNS, "folder", "error")
    axes = [name for name in (rows[0] if rows else {}) if name not in others]
    if not rows:
        raise UserError(f"{path}: has no row")
    jobs = []
    for row in rows:
        figures = {name: parse_number(row.get(column) or "") for column, name in COLUMNS.items()}
        numbers = {name: float(x) for name, x in figures.items() if not isinstance(x, str)}
        place = {axis: parse_number(row[axis]) for axis in axes}
        jobs.append(Job(place, numbers, row.get("folder") or "", row.get("error") or ""))
    return axes, jobs


def read_declared(folder: Path) -> dict[str, list[Value]]:
    """Return the values of each axis in the order in which they were asked for, as far as that is
    told.
    """
    return {
        key: [parse_number(value.strip()) for value in values.split(",")]
        for key, values in read_asked(folder).items()
    }


def read_asked(folder: Path) -> dict[str, str]:
    """Return what a sweep was asked for: the values of each setting, swept or not, as typed."""
    file = folder / "multirun.yaml"
    content = read_yaml(file)
    asked = dict(read_part(content, ("hydra", "sweeper", "params"), file))
    asked |= read_typed(read_texts(read_part(content, ("hydra", "overrides"), file), "task", file))
    return {str(key): str(values) for key, values in asked.items()}


def make_sort_key(order: Sequence[Value]) -> Callable[[Value], tuple[int, float, str]]:
    """Return a sorting key: numbers by size, names as they were asked for."""
    places = {str(value): i for i, value in enumerate(order)}

    def key(value: Value) -> tuple[int, float, str]:
        if not isinstance(value, str):
            return 0, float(value), ""
        return 1, float(places.get(value, len(places))), value

    return key


def parse_number(text: str) -> Value:
    """Return a text as the number that it is, else as it is; so is NaN, and what is too large."""
    for kind in (int, float):
        with suppress(ValueError):
            number = kind(text)
            if abs(number) <= MOST:
                return number
    return text


def group_jobs(sweep: Sweep) -> list[Group]:
    """Return the runs grouped by all axes but the seed, in the axes' order."""
    out: dict[tuple[Value, ...], Group] = {}
    for job in sweep.jobs:
        place = {axis: job.place[axis] for axis in sweep.shown}
        out.setdefault(tuple(place.values()), Group(place, [])).jobs.append(job)
    return list(out.values())


def find_auc(jobs: Sequence[Job]) -> str | None:
    """Return the metric that poses are scored by; None where no run has any."""
    kinds = {find_error(job.numbers) for job in jobs if "add/auc" in job.numbers}
    # plain ADD where a sweep is of several objects, and one has no symmetries
    return f"{min(kinds)}/auc" if kinds else None


def are_detectors(jobs: Sequence[Job]) -> bool:
    """Tell whether a sweep's runs are ranked as detectors though some predict poses: the others do
    not, and an ADD AUC does not compare with their score.
    """
    posed = {"add/auc" in job.numbers for job in jobs}
    return len(posed) == 2 and all(job.numbers.keys() >= {*DETECTING} for job in jobs)


def list_judging(jobs: Sequence[Job]) -> list[str]:
    """Return the metrics that the score of runs is made of: one of poses, or two of detectors."""
    known = {key for job in jobs for key in job.numbers}
    auc = find_auc(jobs)
    if auc and not are_detectors(jobs):
        return [auc]
    return [key for key in DETECTING if key in known]


def find_median(job: Job) -> tuple[str, float] | None:
    """Return the key and the value of the median error that decides between runs of one score;
    None where it is infinite, or the run is a detector's.
    """
    for error in (find_error(job.numbers), "add"):  # an earlier summary.csv has only the latter
        if (key := f"{error}/median_mm") in job.numbers:
            return key, job.numbers[key]
    return None


def rank(jobs: Sequence[Job], as_detectors: bool) -> tuple[float, float]:
    """Return what the best of all has most of: the mean score to one decimal, then (where it ties)
    the least median error, up to symmetry where it is known.

    as_detectors: Whether their poses do not count (see `are_detectors`).
    """
    if as_detectors:
        jobs = [job._replace(numbers={key: job.numbers[key] for key in DETECTING}) for job in jobs]
    medians = [median[1] if (median := find_median(job)) else math.inf for job in jobs]
    return round(mean(score_numbers(job.numbers, -math.inf) for job in jobs), 1), -mean(medians)


def find_best_job(sweep: Sweep) -> Job:
    """Return the run with the highest score, of those with the best setting: one lucky seed makes
    no setting the best. Of those that tie, the one with the least median error.

    Raises UserError where every run has failed.
    """
    if not sweep.jobs:
        raise UserError(f"sweep={sweep.folder}: all of its {len(sweep.failed)} runs failed")
    found, as_detectors = group_jobs(sweep), are_detectors(sweep.jobs)
    return max(found[find_best_group(found)].jobs, key=lambda job: rank([job], as_detectors))


def find_ties(sweep: Sweep) -> int:
    """Return how many runs have the best run's score to one decimal."""
    as_detectors = are_detectors(sweep.jobs)
    best = rank([find_best_job(sweep)], as_detectors)[0]
    return sum(rank([job], as_detectors)[0] == best for job in sweep.jobs)


def find_best_group(found: Sequence[Group]) -> int:
    """Return which group has the highest mean score; of those that tie, the one with the least
    median error.
    """
    as_detectors = are_detectors([job for group in found for job in group.jobs])
    ranks = [rank(group.jobs, as_detectors) for group in found]
    return ranks.index(max(ranks))
