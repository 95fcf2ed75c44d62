"""What a track is written down as: a row an object and frame, and the figures of all rows."""

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from posefilter.confidence.verdicts import Verdict
from posefilter.files import open_whole_text
from posefilter.metrics.errors import add, add_s
from posefilter.metrics.scores import summarize
from posefilter.metrics.tracks import find_gaps, measure_jitter
from posefilter.paths import name_in_table
from posefilter.tracking.track import TrackResult
from posefilter.types import ObjectModel

_COLUMNS = (
    "video", "frame", "scene_id", "im_id", "obj_id", "object", "status", "verdict", "score",
    "objectness", "presence", "probability", "scale_ratio", "particles", "add_mm", "add_s_mm",
    "seconds",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class TrackSummary:
    """What is kept of a `TrackResult`: the beliefs of an hour's video would fill the memory."""

    object: str
    pose: np.ndarray  # (4, 4) camera_from_object [m]
    status: str
    is_tracked: bool
    verdict: Verdict | None
    score: float
    probability: float | None
    presence: float | None
    objectness: float
    scale_ratio: float
    particles: int
    seconds: float
    warnings: tuple[str, ...]
    standard_deviations: list[float]  # as of `Result.covariance` [m, rad]


class TrackRow(NamedTuple):
    """One object in one frame."""

    video: str
    frame: str
    scene_id: int
    im_id: int
    obj_id: int
    result: TrackSummary
    image_seconds: float  # by the clock, of all objects
    truth: np.ndarray | None  # (4, 4) camera_from_object [m], where it is known
    add: float  # error of the pose [m]; NaN without a truth
    add_s: float


def make_row(
    video: str,
    frame: str,
    ids: tuple[int, int, int],
    result: TrackResult,
    image_seconds: float,
    truth: np.ndarray | None,
) -> TrackRow:
    """Return the row of a frame's result.  ids: of scene, image and object, as BOP has them."""
    errors = (math.nan, math.nan)
    if truth is not None:
        pair = (torch.from_numpy(result.pose)[None], torch.from_numpy(truth).double()[None])
        points = result.object_model.points.cpu()
        errors = (float(add(*pair, points.double())), float(add_s(*pair, points)))
    summary = summarize_result(result)
    return TrackRow(video, frame, *ids, summary, image_seconds, truth, *errors)


def summarize_result(result: TrackResult) -> TrackSummary:
    """Return what is kept of a result."""
    deviations = np.sqrt(np.diag(result.covariance)).tolist()
    own = {one.name: getattr(result, one.name) for one in fields(TrackSummary)[:-1]}
    return TrackSummary(**own, standard_deviations=deviations)


def compute_figures(rows: Sequence[TrackRow], object_model: ObjectModel) -> dict[str, Any]:
    """Return the figures of one object's rows, frames of one video or of several in their order.

    A frame counts as missed where the object is lost, and its error as infinite. A false track is
    a frame in which the object is said to be there, and its ADD-S is 0.1 diameters or more, or the
    dataset has no pose of it: it is away, or hidden wholly.

    Args:
        rows: Of one object.
        object_model: The object.

    Returns:
        `frames`, `lost`, `gaps` (frames until each loss ended; null where it did not), the seconds
        of a first frame and the median of the others; and where truths are known `add` and `add_s`
        as in metrics.json, `false_tracks`, and the jitter of frames that follow each other.
    """
    tracked = [row.result.is_tracked for row in rows]
    later = [r.result.seconds for r in rows if r.result.status == "tracked"]
    gaps = [
        gap.length if gap.ended else None
        for video in dict.fromkeys(row.video for row in rows)
        for gap in find_gaps([row.result.is_tracked for row in rows if row.video == video])
    ]
    seconds = float(np.median(later)) if later else math.nan
    started = [row.result.seconds for row in rows if row.result.status == "started"]
    out: dict[str, Any] = {
        "frames": len(rows),
        "lost": len(rows) - sum(tracked),
        "gaps": gaps,
        "seconds_started": started[0] if started else None,
        "seconds_tracked": seconds,
        "frames_per_second": 1 / seconds if later else None,
    }
    known = [row for row in rows if row.truth is not None]
    if not known:
        return out
    for name in ("add", "add_s"):
        errors = [getattr(row, name) if row.result.is_tracked else math.inf for row in known]
        out[name] = summarize(torch.tensor(errors), object_model.diameter)
    limit = 0.1 * object_model.diameter
    out["false_tracks"] = sum(
        row.result.is_tracked and (row.truth is None or row.add_s >= limit) for row in rows
    )
    jitters = [measure_row_jitter(run, object_model) for run in _follow_ups(rows)]
    shifts, turns = zip(*jitters, strict=True) if jitters else ((), ())
    out["jitter_mm"], out["jitter_deg"] = _rms(shifts), _rms(turns)
    return out


def measure_row_jitter(pair: Sequence[TrackRow], object_model: ObjectModel) -> tuple[float, float]:
    """Return the jitter of two rows that follow each other, in mm and degrees."""
    poses = torch.from_numpy(np.stack([row.result.pose for row in pair]))
    truth = torch.from_numpy(np.stack([row.truth for row in pair if row.truth is not None]))
    return measure_jitter(poses, truth.double(), object_model.center.cpu().double())


def _follow_ups(rows: Sequence[TrackRow]) -> list[tuple[TrackRow, TrackRow]]:
    """Return the pairs of rows, one after the other in a video, in which the object was tracked and
    its true pose is known.
    """
    good = [row.result.is_tracked and row.truth is not None for row in rows]
    pairs = zip(pairwise(rows), pairwise(good), strict=True)
    return [(a, b) for (a, b), both in pairs if a.video == b.video and all(both)]


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else math.nan


def describe_row(row: TrackRow) -> dict[str, Any]:
    """Return a row as plain content, a line of poses.jsonl."""
    result = row.result
    own = ("video", "frame", "scene_id", "im_id", "obj_id")
    measured = ("score", "objectness", "presence", "probability", "scale_ratio", "particles")
    return {
        **{name: getattr(row, name) for name in own},
        "object": result.object,
        "status": result.status,
        "verdict": result.verdict,
        "camera_from_object": result.pose.tolist(),
        **{name: getattr(result, name) for name in measured},
        "standard_deviations": result.standard_deviations,
        "add_mm": 1000 * row.add,
        "add_s_mm": 1000 * row.add_s,
        "seconds": result.seconds,
    }


def write_rows(folder: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write poses.jsonl, a line a row, and tracks.csv, the same without the poses.

    Numbers that are none are null in the one, and empty in the other.
    """
    with open_whole_text(folder / "poses.jsonl") as file:
        file.writelines(map(format_row, rows))
    with open_whole_text(folder / "tracks.csv") as file:
        writer = csv.DictWriter(file, _COLUMNS, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        names = ("video", "frame")
        writer.writerows(
            row | {name: name_in_table(str(row[name])) for name in names} for row in rows
        )


def format_row(row: dict[str, Any]) -> str:
    """Return a line of poses.jsonl."""
    return json.dumps(row, allow_nan=False) + "\n"
