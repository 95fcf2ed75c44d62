"""Test what calibrated checkpoints say of themselves, on rendered frames that no calibration saw.

    python bench/calibrated.py --root DIR --meshes DIR --rows FILE.jsonl [--frames 200]
        [--without 100] [--max-visibility 0.25] [--minutes 5] FILE.ckpt ...
    python bench/calibrated.py --table FILE.jsonl      # only prints the tables
    python bench/calibrated.py --cross FILE.jsonl [--most 80] [--leave-out score]
        [--tolerance add_s=0.1 translation_mm=5]  # the same, of calibrations on these frames

With --cross the checkpoints' own calibrations do not count: the frames of each object are divided
into five parts by scene, and each part is judged by a calibration on the other four.  --most takes
so many of their frames with the object and as many without, --leave-out leaves out witnesses.
With --tolerance a pose is right that keeps it (`posefilter.PoseTolerance`), and the probability is
that of it.

Every frame below --root is taken, in a fixed shuffle: --frames with a visibility above 0.1, of
these with --max-visibility only those that show less, and --without that lack the object. A row an
image is added to the file; started again, it goes on, and --minutes ends it early. What the filter
leaves is kept in FILE.beliefs: without the rows, they are judged anew in a fraction of the time, by
other calibrations of the same filter.

Shown is the share of the object that is seen: the visible share of what lies in the frame, times
the share of its surface points that the frame holds, since the frame cuts many off.  Coverage is
that of conformal and of credible sets.  In the band: the share of the true outline's points, of the
hull, that lie in the 95 % band of the belief (`Result.draw_band`).  The last table is of frames
whose estimate is right: ellipsoids are of the belief's covariance about the estimate, in the shape
of Student's t.
"""

import itertools
import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from checkpoint_frames import open_frames
from confidence import degrees_of, measure_error, read_tolerance
from marked import format_table
from programs import make_parser
from scipy.stats import kstest

from posefilter.belief import Belief
from posefilter.cli.checkpoints import method_of, read_checkpoint
from posefilter.confidence.belief_scale import DEGREES
from posefilter.confidence.conformal import fit_conformal
from posefilter.confidence.fit import Frames, cross_validate, fit_calibration
from posefilter.confidence.tolerance import RIGHT, PoseErrors, PoseTolerance, measure_pose_errors
from posefilter.data.absent import hide_annotation
from posefilter.data.loaders import make_loader
from posefilter.figures.band import find_band, measure_cover
from posefilter.figures.canvas import View
from posefilter.files import open_whole
from posefilter.geometry.camera import project
from posefilter.geometry.pose import transform
from posefilter.metrics.confidence import calibration_error, error_at_coverage
from posefilter.metrics.credibility import SHOWN, score_truth
from posefilter.metrics.diagnostics import auroc
from posefilter.models.base import PoseEstimator
from posefilter.result import make_belief
from posefilter.types import Batch, BeliefBatch

QUARTERS = (0.0, 0.25, 0.5, 0.75)
LEVEL = 0.95  # of the band
LEVELS = " / ".join(map(str, SHOWN))
SURE, LOST = 0.8, 0.2  # found from this probability, absent below this presence
Row = dict[str, Any]


class Observation(NamedTuple):
    """What a filter makes of a batch of images, before any calibration of its belief."""

    belief: BeliefBatch
    features: dict[str, torch.Tensor]  # (B,) each
    truth: torch.Tensor  # (B, 4, 4); of images without the object not used
    intrinsics: torch.Tensor  # (B, 3, 3)
    visibility: torch.Tensor  # (B,)
    size: tuple[int, int]  # of the images: height, width
    scenes: tuple[str, ...]  # B


def observe(method: PoseEstimator, batch: Batch, number: int, scenes: Sequence[str]) -> Observation:
    """Run the filter on a batch; `scenes` are those of its images."""
    seen = Batch(*hide_annotation(batch))
    with torch.no_grad():
        trace = method.predict_step(seen, number)
        features = method.collect_features(trace, seen)
    size = (batch.depth.shape[-2], batch.depth.shape[-1])
    about = (batch.camera_from_object, batch.intrinsics, batch.visibility, size, tuple(scenes))
    return Observation(trace.belief, dict(features), *about)


def save_observation(found: Observation, file: Path) -> None:
    """Write an observation as .npz, whole or not at all."""
    arrays = {key: part.numpy() for key, part in found.belief._asdict().items()}
    arrays |= {f"feature.{key}": part.numpy() for key, part in found.features.items()}
    arrays |= {"truth": found.truth.numpy(), "intrinsics": found.intrinsics.numpy()}
    arrays |= {"visibility": found.visibility.numpy(), "size": np.array(found.size)}
    with open_whole(file, sync=False) as stream:
        np.savez(stream, **arrays, scenes=np.array(found.scenes))


def load_observation(file: Path) -> Observation:
    """Read what `save_observation` writes."""
    with np.load(file) as read:
        arrays = dict(read)
    tensors = {k: torch.from_numpy(v) for k, v in arrays.items() if k not in ("scenes", "size")}
    features = {k.removeprefix("feature."): v for k, v in tensors.items() if "." in k}
    height, width = arrays["size"].tolist()
    return Observation(
        BeliefBatch(*(tensors[key] for key in BeliefBatch._fields)),
        features,
        tensors["truth"],
        tensors["intrinsics"],
        tensors["visibility"],
        (height, width),
        tuple(arrays["scenes"].tolist()),
    )


def measure_shown(found: Observation, points: torch.Tensor) -> torch.Tensor:
    """Return the share of the object that is seen.  points (P, 3) [m] -> (B,)."""
    at = transform(found.truth, points)
    u, v = project(at, found.intrinsics).unbind(-1)
    height, width = found.size
    inside = (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5) & (at[..., 2] > 0.01)
    return found.visibility * inside.float().mean(1)


def measure_band(
    belief: Belief, truth: np.ndarray, hull: np.ndarray, K: np.ndarray, size: tuple[int, int]
) -> float:
    """Return the share of the true outline's points that lie in the band; NaN where there are none.

    truth (4, 4), hull (V, 3) [m], K (3, 3) [px], size (height, width).
    """
    height, width = size
    view, poses, weights = View(-0.5, -0.5, 1.0, width, height), belief.samples, belief.weights
    surely, maybe = find_band(measure_cover(poses, weights, hull, K, view), LEVEL)
    own = measure_cover(truth[None], np.ones(1), hull, K, view) > 0.5
    mask, ring = own.astype(np.uint8), np.ones((3, 3), np.uint8)
    # the outline's outermost pixels, and those beyond it; the frame's edge is no outline
    inner = own & (np.asarray(cv2.erode(mask, ring, borderValue=1)) == 0)
    outer = ~own & (np.asarray(cv2.dilate(mask, ring)) > 0)
    total = int(inner.sum()) + int(outer.sum())
    missed = int((inner & ~maybe).sum()) + int((outer & surely).sum())
    return 1 - 2 * missed / total if total else float("nan")


def look(method: PoseEstimator, found: Observation, there: bool) -> Iterator[Row]:
    """Yield a row an image of what the method's calibration says of it."""
    object_model, calibration = method.object_model, method.calibration
    assert calibration is not None
    said = calibration.assess(found.features)
    belief, draws = method.calibrate_belief(found.belief, said)
    errors, seen = None, []
    if there:
        errors = measure_pose_errors(belief.best, found.truth, object_model)
        # as it is calibrated, and as the filter leaves it
        seen = [score_truth(one, found.truth, object_model) for one in (belief, found.belief)]
    shown = measure_shown(found, object_model.points[:: max(1, len(object_model.points) // 500)])
    hull = object_model.hull.double().numpy()
    for i, scene in enumerate(found.scenes):
        off = [math.nan] * 4 if errors is None else [float(part[i]) for part in errors]
        row: Row = {"object": object_model.name, "there": there, "errors": off}
        row["right"] = bool(RIGHT.accepts(PoseErrors(*np.array(off))))
        row |= {"presence": float(said.presence[i]), "probability": float(said.probability[i])}
        row |= {"scene": scene, "features": {k: float(v[i]) for k, v in found.features.items()}}
        if there:
            row |= {"visibility": float(found.visibility[i]), "shown": float(shown[i])}
            sets, (calibrated, plain) = calibration.conformal, seen
            assert sets is not None
            by_surface = sets.by == "surface"
            value = float(found.features["surface"][i]) if by_surface else row["probability"]
            nonconformity = float(calibrated.nonconformity[i])
            row["nonconformity"] = nonconformity
            row["held"] = [nonconformity <= sets.find_limit(level / 100, value) for level in SHOWN]
            truth, K = (x[i].double().numpy() for x in (found.truth, found.intrinsics))
            for which, scores, of in (("", calibrated, belief), ("plain_", plain, found.belief)):
                own = make_belief(of, i, object_model, draws if of is belief else None)
                row[f"{which}rank"] = float(scores.rank[i])
                row[f"{which}log_density"] = float(scores.log_density[i])
                estimate = of.best[i].double().numpy()
                degrees = degrees_of(method) if of is belief else DEGREES
                error = measure_error(own, estimate, truth, degrees)
                row |= {f"{which}{key}": value for key, value in error.items()}
                row[f"{which}band"] = measure_band(own, truth, hull, K, found.size)
        yield row


def collect(file: str, options: Any, end: float) -> bool:
    """Add the rows of one checkpoint that are missing; tell whether none is left."""
    if time.monotonic() > end:
        return False
    checkpoint = read_checkpoint(file)
    method = method_of(checkpoint, lightning=False)
    name, method.seed = method.object_model.name, 0
    if method.calibration is None or method.calibration.conformal is None:
        raise SystemExit(f"{file}: is not calibrated, or without conformal sets")
    rows = read_rows(options.rows) if options.rows.exists() else []
    store = options.rows.with_suffix(".beliefs")
    store.mkdir(parents=True, exist_ok=True)
    data = open_frames(file, checkpoint, name, options)
    shown, absent = data.val_dataset, data.absent_dataset("val", options.without)
    if options.max_visibility < math.inf:
        shares = (float(shown[i].visibility) for i in range(len(shown)))
        few = [share < options.max_visibility for share in shares]
        shown.records = list(itertools.compress(shown.records, few))
    parts = ((shown, True), (absent, False))
    for dataset, there in parts:
        done = sum(row["object"] == name and row["there"] == there for row in rows)
        for number, batch in enumerate(make_loader(dataset, 8, 0)):
            if 8 * number < done:
                continue
            if time.monotonic() > end:
                return False
            stored = store / f"{name}.{'with' if there else 'without'}.{number:04d}.npz"
            if stored.exists():
                found = load_observation(stored)
            else:
                records = dataset.records[8 * number : 8 * number + 8]
                found = observe(method, batch, number, [one.group for one in records])
                save_observation(found, stored)
            with options.rows.open("a") as out:
                lines = [json.dumps(row) for row in look(method, found, there)]
                out.write("\n".join(lines) + "\n")
    return True


def read_rows(file: Path) -> list[Row]:
    """Return the rows of a file."""
    return [json.loads(line) for line in file.read_text().splitlines()]


def judge_across(
    rows: Sequence[Row],
    max_frames: int | None = None,
    leave_out: Sequence[str] = (),
    tolerance: PoseTolerance = RIGHT,
    folds: int = 5,
    seed: int = 0,
) -> list[Row]:
    """Return the rows with the probabilities and sets of calibrations on other scenes' rows.

    Args:
        rows: Of `look`.
        max_frames: Frames with the object, and without, that a calibration takes; None: all.
        leave_out: Witnesses that it does without.
        tolerance: What a right pose is.
        folds: Parts of the scenes.
        seed: Of their shuffle.
    """
    out = []
    for name in dict.fromkeys(row["object"] for row in rows):
        own = [row for row in rows if row["object"] == name]
        scenes = sorted({row["scene"] for row in own})
        rng = np.random.default_rng(seed)
        order = rng.permutation(scenes)
        fold = {scene: k % folds for k, scene in enumerate(order)}
        part = np.array([fold[row["scene"]] for row in own])
        frames = gather_frames(own, leave_out)
        nonconformity, visibility = (
            np.array([row.get(key, np.nan) for row in own])
            for key in ("nonconformity", "visibility")
        )
        for k in range(folds):
            learned = rng.permutation(np.flatnonzero(part != k))
            shown = frames.present[learned]
            both = [learned[shown == there][:max_frames] for there in (True, False)]
            taken = np.concatenate(both)
            chosen, seen = frames.select(taken), frames.present[taken]
            made, known = fit_calibration(chosen, "fat"), cross_validate(chosen).probability.numpy()
            sets = fit_conformal(nonconformity[taken][seen], known[seen], visibility[taken][seen])
            held = np.flatnonzero(part == k)
            values = torch.from_numpy(frames.values[held])
            found, usual = made.assess_features(values, tolerance), made.assess_features(values)
            each = zip(held, found.presence, found.probability, usual.probability, strict=True)
            for i, *parts in each:
                presence, said, probability = (float(part) for part in parts)
                row = own[i] | {"presence": presence, "probability": said}
                if tolerance != RIGHT:
                    row["right"] = bool(tolerance.accepts(PoseErrors(*np.array(row["errors"]))))
                if row["there"]:
                    limits = [sets.find_limit(one / 100, probability) for one in SHOWN]
                    row["held"] = [row["nonconformity"] <= limit for limit in limits]
                out.append(row)
    return out


def gather_frames(rows: Sequence[Row], leave_out: Sequence[str]) -> Frames:
    """Return rows of one object as calibration frames, without some witnesses."""
    names = tuple(name for name in rows[0]["features"] if name not in leave_out)
    values = np.array([[row["features"][name] for name in names] for row in rows])
    there, right = (np.array([row[key] for row in rows]) for key in ("there", "right"))
    known = all("errors" in row for row in rows)  # not in rows of earlier versions
    errors = PoseErrors(*np.array([row["errors"] for row in rows]).T) if known else None
    return Frames(names, values, there, right, errors)


def share(hits: Sequence[Any]) -> str:
    """Return the percentages of columns of hits, such as `48 / 81`."""
    return " / ".join(f"{100 * x:.0f}" for x in np.atleast_1d(np.mean(hits, axis=0)))


def cover(rows: Sequence[Row]) -> list[str]:
    """Return frames, coverage of conformal and of credible sets, and the share in the band."""
    band = 100 * float(np.nanmean([row["band"] for row in rows]))
    ranks = [[row["rank"] < level / 100 for level in SHOWN] for row in rows]
    return [str(len(rows)), share([row["held"] for row in rows]), share(ranks), f"{band:.0f}"]


def tabulate_coverage(rows: Sequence[Row]) -> str:
    """Return coverage by object, by visibility and by what is shown."""
    head = ("frames of", "frames", f"conformal sets of {LEVELS} %", "credible sets", "in the band")
    own = [row for row in rows if row["there"]]
    return format_table(head, [[name, *cover(some)] for name, some in divide(own)])


def divide(rows: Sequence[Row]) -> Iterator[tuple[str, list[Row]]]:
    """Yield groups of rows with their names: objects, all, visibility, what is shown."""
    for name in dict.fromkeys(row["object"] for row in rows):
        yield name, [row for row in rows if row["object"] == name]
    if rows:
        yield "all", list(rows)
    for key in ("visibility", "shown"):
        for low in QUARTERS:
            high = low + 0.25 if low < 0.75 else 2
            some = [row for row in rows if low <= row[key] < high]
            if some:
                yield f"{key} {low:g} to {min(high, 1):g}", some


def tabulate_beliefs(rows: Sequence[Row]) -> str:
    """Return what beliefs say of frames whose estimate is right, as they are calibrated and as the
    filter leaves them.
    """
    own = [row for row in rows if row["right"]]
    lines = []
    for name, some in divide(own):
        for which, said in (("", "calibrated"), ("plain_", "as the filter leaves it")):
            levels = [[row[f"{which}level"] < level / 100 for level in SHOWN] for row in some]
            ranks = [[row[f"{which}rank"] < level / 100 for level in SHOWN] for row in some]
            translation, rotation = np.median([row[f"{which}says"] for row in some], axis=0)
            lines.append(
                [
                    *(name, said, str(len(some)), share(levels), share(ranks)),
                    share([row[f"{which}within"] for row in some]),
                    f"{1000 * translation:.1f} mm, {math.degrees(rotation):.1f}",
                    f"{100 * float(np.nanmean([row[f'{which}band'] for row in some])):.0f}",
                    f"{np.mean([row[f'{which}log_density'] for row in some]):.1f}",
                    f"{kstest([row[f'{which}level'] for row in some], 'uniform').pvalue:.3f}",
                ]
            )
    head = ["right frames of", "belief", "frames", f"ellipsoids of {LEVELS} %", "credible sets"]
    head += ["within what it says at 95 %: translation / rotation", "which is in the median"]
    head.append("in the band")
    return format_table([*head, "log density", "levels uniform: p"], lines)


def tell_presence(rows: Sequence[Row], min_shown: float) -> str:
    """Return the AUROC of the presence, of frames that show so much of the object."""
    some = [row for row in rows if not row["there"] or row["shown"] >= min_shown]
    presence = torch.tensor([row["presence"] for row in some], dtype=torch.float64)
    return f"{float(auroc(presence, torch.tensor([row['there'] for row in some]))):.3f}"


def tell_confidence(rows: Sequence[Row]) -> list[str]:
    """Return the cells of a line about probabilities."""
    own = [row for row in rows if row["there"]]
    every = torch.tensor([row["probability"] for row in rows], dtype=torch.float64)
    right = torch.tensor([row["right"] for row in rows])
    at = torch.tensor([row["there"] for row in rows])
    wrong = 1 - float(right[at].double().mean())
    kept = float(error_at_coverage(every[at], right[at]))
    found = (every >= SURE).numpy()
    lost = sum(row["presence"] < LOST for row in own)
    return [
        f"{len(own)}, {len(rows) - len(own)}",
        f"{float(auroc(every[at], right[at])):.3f}",
        f"{float(calibration_error(every, right)):.3f}",
        f"{100 * wrong:.0f} %, {100 * kept:.0f} %",
        *(tell_presence(rows, least) for least in (0.0, 0.25, 0.5)),
        f"{100 * found[at.numpy()].mean():.0f} %",
        str(int((found & at.numpy() & ~right.numpy()).sum())),
        str(int((found & ~at.numpy()).sum())),
        str(lost),
    ]


def tabulate_confidence(rows: Sequence[Row]) -> str:
    """Return what the probabilities are worth, by object and of all."""
    head = ["object", "frames with it, without", "AUROC right", "ECE", "wrong, of 80 % kept"]
    head += ["AUROC presence", "a quarter shown", "half shown", "found", "found wrongly"]
    head += ["found where absent", "absent where there"]
    names = dict.fromkeys(row["object"] for row in rows)
    lines = [[n, *tell_confidence([row for row in rows if row["object"] == n])] for n in names]
    return format_table(head, [*lines, ["all", *tell_confidence(rows)]])


def main() -> int:
    """Collect rows, print the tables; the status is 3 where --minutes ended it."""
    parser = make_parser(__doc__)
    parser.add_argument("files", nargs="*")
    parser.add_argument("--root")
    parser.add_argument("--meshes")
    parser.add_argument("--rows", type=Path)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--without", type=int, default=100)
    parser.add_argument("--max-visibility", type=float, default=math.inf)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--table", type=Path, help="only print the tables of these rows")
    parser.add_argument("--cross", type=Path, help="the same, of calibrations on these rows")
    parser.add_argument("--most", type=int, help="frames with the object, and without, of these")
    parser.add_argument("--leave-out", nargs="+", default=[], help="witnesses")
    parser.add_argument("--tolerance", nargs="+", default=[], help="such as add_s=0.1")
    options = parser.parse_args()
    torch.set_num_threads(1)
    tolerance = read_tolerance(options.tolerance) or RIGHT
    whole = True
    if options.table is None and options.cross is None:
        if not (options.files and options.root and options.meshes and options.rows):
            parser.error("checkpoints, --root, --meshes and --rows are needed")
        end = time.monotonic() + 60 * options.minutes
        left = [file for file in options.files if not collect(file, options, end)]
        whole = not left
    rows = read_rows(options.table or options.cross or options.rows)
    if options.cross is not None:
        rows = judge_across(rows, options.most, options.leave_out, tolerance)
    tables = [tabulate_coverage(rows), tabulate_confidence(rows)]
    if all("level" in row for row in rows if row["there"]):  # not in rows of earlier versions
        tables.append(tabulate_beliefs(rows))
    print(*tables, sep="\n\n")
    return 0 if whole else 3


if __name__ == "__main__":
    sys.exit(main())
