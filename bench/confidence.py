"""Look for every object in every photograph of a dataset, whether it is there or not, and count
what calibrated checkpoints declare, and what they say of the error of right answers.

    python bench/confidence.py --source ycb_video --root DIR --meshes DIR [--weights FILE ...]
        [--every 10] [--input depth_x2 ...] [--tolerance add_s=0.1] [--out FILE.json]

Photographs serve as a test alone: no calibration sees them.  `--input` spoils what a user types or
connects: a wrong depth scale, intrinsics of another resolution or with two numbers exchanged, the
depth of another photograph, colors exchanged or upside down.  `--input all` does so in every way,
with the objects that a photograph shows, and counts the answers that are declared found and wrong
(ADD of 0.1 diameters or more, up to symmetry; or by --tolerance, see `posefilter.PoseTolerance`).
"""

import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from marked import format_table
from programs import make_parser
from scipy.stats import f as f_distribution

import posefilter
from posefilter.belief import Belief
from posefilter.confidence.belief_scale import DEGREES
from posefilter.confidence.tolerance import RIGHT, PoseTolerance, measure_pose_errors
from posefilter.data.frames import Sample
from posefilter.data.readers.base import BaseReader
from posefilter.data.readers.registry import open_meshes, open_reader
from posefilter.errors import UserError
from posefilter.geometry.pose_statistics import twist_between
from posefilter.metrics.credibility import SHOWN
from posefilter.models.base import PoseEstimator
from posefilter.result import Result

Inputs = tuple[np.ndarray, np.ndarray, np.ndarray]
Spoil = Callable[[Sample, Sample], Inputs]  # of a photograph, and of one of another scene
HEAD = ("object", "with it", "right", "found", "found and right", "absent")
HEAD += ("without it", "found", "unsure", "highest probability")
HEAD_SPOILED = ("input", "asked for", "refused", "right", "found", "found and wrong")
HEAD_SPOILED += ("highest probability of a wrong one", "flagged as of a wrong size")


def _stretch(factor: float) -> Spoil:
    return lambda one, _: (one.rgb, factor * one.depth, one.intrinsics)


def _zoom(factor: float) -> Spoil:
    return lambda one, _: (one.rgb, one.depth, one.intrinsics @ np.diag([factor, factor, 1.0]))


def _resolve(factor: float) -> Spoil:
    """Take the intrinsics of the same camera at another resolution."""
    return lambda one, _: (one.rgb, one.depth, np.diag([factor, factor, 1.0]) @ one.intrinsics)


def _exchange(one: Sample, _: Sample) -> Inputs:
    """Exchange fx and cx, fy and cy."""
    K = one.intrinsics.copy()
    K[0, 0], K[0, 2], K[1, 1], K[1, 2] = K[0, 2], K[0, 0], K[1, 2], K[1, 1]
    return one.rgb, one.depth, K


SPOILED: dict[str, Spoil] = {
    "as_it_is": lambda one, _: (one.rgb, one.depth, one.intrinsics),
    "depth_x10": _stretch(10.0),
    "depth_x2": _stretch(2.0),
    "depth_x1.5": _stretch(1.5),
    "depth_x1.25": _stretch(1.25),
    "depth_x0.8": _stretch(0.8),
    "depth_x0.5": _stretch(0.5),
    "depth_x0.1": _stretch(0.1),
    "focal_x1.5": _zoom(1.5),
    "focal_x0.67": _zoom(0.67),
    "resolution_x2": _resolve(2.0),
    "resolution_x0.5": _resolve(0.5),
    "fx_cx_exchanged": _exchange,
    "another_depth": lambda one, other: (one.rgb, other.depth, one.intrinsics),
    "red_blue_exchanged": lambda one, _: (one.rgb[..., ::-1].copy(), one.depth, one.intrinsics),
    "color_upside_down": lambda one, _: (one.rgb[::-1].copy(), one.depth, one.intrinsics),
}


def list_frames(reader: BaseReader) -> list[list[int]]:
    """Return the records of each image."""
    frames: dict[str, list[int]] = {}
    for i, record in enumerate(reader.records()):
        frames.setdefault(record.name, []).append(i)
    return list(frames.values())


def list_images(reader: BaseReader, every: int) -> list[list[int]]:
    """Return the records of each image, every so many images of a scene."""
    scenes: dict[str, list[list[int]]] = {}
    records = reader.records()
    for own in list_frames(reader):
        scenes.setdefault(records[own[0]].group, []).append(own)
    return [own for many in scenes.values() for own in many[::every]]


def degrees_of(method: PoseEstimator) -> int:
    """Return the degrees of freedom of a method's calibrated beliefs."""
    scale = None if method.calibration is None else method.calibration.belief_scale
    return DEGREES if scale is None else scale.degrees


def is_right_pose(result: Result, truth: np.ndarray) -> bool:
    """Return whether a pose keeps the tolerance that was asked for, else 0.1 diameters (ADD);
    truth (4, 4).
    """
    true = torch.from_numpy(truth).double()[None]
    errors = measure_pose_errors(torch.from_numpy(result.pose)[None], true, result.object_model)
    return bool((result.pose_tolerance or RIGHT).accepts(errors))


def measure_error(
    belief: Belief, estimate: np.ndarray, truth: np.ndarray, degrees: int = DEGREES
) -> dict[str, Any]:
    """Return how far an estimate is off, and what its belief says of that.

    Args:
        belief: About the estimate.
        estimate: (4, 4).
        truth: (4, 4).
        degrees: Of freedom, of the calibrated belief (`BeliefScale`).

    Returns:
        off: Translation of the center [m] and rotation [rad].  says: What `Belief.uncertainty`
        gives for them at 95 %.  within: Whether each is within it.  level: Of the smallest
        ellipsoid that holds the truth, of `Belief.error_covariance` and in the shape of Student's
        t.
    """
    lone = replace(belief, samples=truth[None], weights=np.ones(1), draws=0)
    near = lone.canonicalize(estimate)
    about = torch.from_numpy(estimate)
    twist = twist_between(about, torch.from_numpy(near.samples[0]), torch.from_numpy(belief.center))
    error, spread = twist.numpy(), belief.error_covariance(estimate)
    squared = float(error @ np.linalg.lstsq(spread, error, rcond=1e-9)[0])
    sure = belief.uncertainty()
    off = [float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))]
    says = [sure.translation, sure.rotation]
    within = [one <= most for one, most in zip(off, says, strict=True)]
    # the covariance is n / (n - 2) times the distribution's scale
    level = float(f_distribution.cdf(squared * degrees / (degrees - 2) / 6, 6, degrees))
    return {"off": off, "says": says, "within": within, "level": level}


class ErrorSummary(NamedTuple):
    """What beliefs are worth, of estimates that are right."""

    off: np.ndarray  # (2,) median translation [mm] and rotation [degrees]
    says: np.ndarray  # (2,) what beliefs say of these at 95 %, in the median
    within: np.ndarray  # (2,) how often each is within it [%]
    ellipsoids: np.ndarray  # (4,) how often those of `SHOWN` hold the truth [%]


def summarize_errors(rows: Sequence[Mapping[str, Any]]) -> ErrorSummary:
    """Return the figures of what `measure_error` gives of right estimates, one at least."""
    units = np.array([1000, 180 / math.pi])
    off, says = (units * np.median([row[key] for row in rows], axis=0) for key in ("off", "says"))
    within = 100 * np.mean([row["within"] for row in rows], axis=0)
    inside = [[row["level"] < level / 100 for level in SHOWN] for row in rows]
    return ErrorSummary(off, says, within, 100 * np.mean(inside, axis=0))


def read_tolerance(words: list[str]) -> PoseTolerance | None:
    """Return the tolerance of words such as add_s=0.1; None where there are none."""
    pairs = (one.split("=") for one in words)
    return PoseTolerance(**{name: float(value) for name, value in pairs}) if words else None


def probability_of(result: Result) -> float | None:
    """Return the probability that the verdict goes by; None where there is none."""
    if result.pose_tolerance is None or result.probability is None:
        return result.probability
    return result.probability_within(result.pose_tolerance)


def look(
    estimator: posefilter.Estimator, reader: BaseReader, images: list[list[int]], spoil: str
) -> list[dict[str, Any]]:
    """Return a row an object and image: whether it is there, right, and what was declared."""
    records, rows = list(reader.records()), []
    for own in images:
        there = {records[i].object: reader.read(i) for i in own}
        scene = records[own[0]].group
        other = next((k for k, *_ in images if records[k].group != scene), own[0])
        inputs = SPOILED[spoil](reader.read(own[0]), reader.read(other))
        try:
            (results,) = estimator.predict_batch(*inputs)
        except UserError as error:
            print(error, flush=True)
            refused = {"image": records[own[0]].name, "input": spoil, "verdict": "refused"}
            refused |= {"there": True, "right": False, "probability": 0.0}
            rows += [{"object": name} | refused for name in there]
            continue
        for result in results:
            row = {"object": result.object, "image": records[own[0]].name, "input": spoil}
            row |= {"there": result.object in there, "verdict": result.verdict}
            row |= {"probability": probability_of(result), "presence": result.presence}
            row |= {"scale_ratio": result.scale_ratio, "wrong_size": result.wrong_size}
            if result.object in there:
                sample = there[result.object]
                truth = sample.camera_from_object.astype(np.float64)
                row["right"] = is_right_pose(result, truth)
                degrees = degrees_of(estimator.methods[estimator.objects.index(result.object)])
                row |= measure_error(result.belief, result.pose, truth, degrees)
            rows.append(row)
            print(json.dumps(row), flush=True)
    return rows


def tabulate(rows: list[dict[str, Any]]) -> str:
    """Return the counts as a Markdown table."""
    lines = []
    for name in dict.fromkeys(row["object"] for row in rows):
        own = [row for row in rows if row["object"] == name and row["there"]]
        other = [row for row in rows if row["object"] == name and not row["there"]]
        found = [row for row in own if row["verdict"] == "found"]
        right = sum(row["right"] for row in own)
        lost = sum(row["verdict"] == "absent" for row in own)
        cells = [name, len(own), right, len(found), sum(row["right"] for row in found), lost]
        cells += [len(other), *(sum(r["verdict"] == v for r in other) for v in ("found", "unsure"))]
        cells.append(f"{max((row['probability'] for row in other), default=0):.2f}")
        lines.append(cells)
    return format_table(HEAD, lines)


def tabulate_errors(rows: list[dict[str, Any]]) -> str:
    """Return what beliefs say of right estimates, and how far these are off, as a table."""
    head = ("object", "right", "off, median", "stated at 95 %, median", "within the translation")
    head += ("the rotation", "ellipsoids of 50 and 95 %")
    lines = []
    own = [row for row in rows if row.get("right") and "off" in row]
    for name in [*dict.fromkeys(row["object"] for row in own), "all"] if own else []:
        some = [row for row in own if name in (row["object"], "all")]
        found = summarize_errors(some)
        words = [f"{shift:.1f} mm, {turn:.1f} degrees" for shift, turn in (found.off, found.says)]
        within = np.sum([row["within"] for row in some], axis=0)
        inside = [sum(row["level"] < level for row in some) for level in (0.5, 0.95)]
        lines.append([name, len(some), *words, *within, " and ".join(map(str, inside))])
    return format_table(head, lines)


def tabulate_spoiled(rows: list[dict[str, Any]]) -> str:
    """Return the counts of each way to spoil as a Markdown table, of objects that are there."""
    lines = []
    for name in SPOILED:
        own = [row for row in rows if row["input"] == name and row["there"]]
        found = [row for row in own if row["verdict"] == "found"]
        right = sum(row["right"] for row in own)
        wrong = [row for row in own if not row["right"]]
        refused = sum(row["verdict"] == "refused" for row in own)
        wrong_found = sum(not row["right"] for row in found)
        cells = [name, len(own), refused, right, len(found), wrong_found]
        cells.append(f"{max((row['probability'] for row in wrong), default=0):.2f}")
        cells.append(sum(row.get("wrong_size", False) for row in own))
        lines.append(cells)
    return format_table(HEAD_SPOILED, lines)


def main() -> int:
    """Print a row a line, then the table."""
    parser = make_parser(__doc__)
    parser.add_argument("--weights", nargs="+", default=["all"])
    parser.add_argument("--source", default="ycb_video")
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--meshes", required=True)
    parser.add_argument("--every", type=int, default=10, help="images of a scene")
    parser.add_argument("--input", choices=[*SPOILED, "all"], default="as_it_is")
    parser.add_argument("--tolerance", nargs="+", default=[], help="such as add_s=0.1")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    meshes = open_meshes(options.meshes, None, options.source, None)
    reader = open_reader(options.source, options.root, None, meshes, "skip")
    weights = options.weights
    if options.input == "all" and weights == ["all"]:
        weights = list(reader.objects)
    estimator = posefilter.load(weights, pose_tolerance=read_tolerance(options.tolerance))
    inputs = list(SPOILED) if options.input == "all" else [options.input]
    images = list_images(reader, options.every)
    rows = [row for spoil in inputs for row in look(estimator, reader, images, spoil)]
    if options.input == "all":
        print(tabulate_spoiled(rows))
    else:
        print(tabulate(rows), tabulate_errors(rows), sep="\n\n")
    if options.out is not None:
        options.out.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
