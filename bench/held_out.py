"""Test checkpoints of one object on the same held-out renders, with intervals over scenes.

    python bench/held_out.py --root DIR --meshes DIR [--part test] [--images 48] \
        [--out ROWS.json] A.ckpt [B.ckpt ...]
    python bench/held_out.py --root DIR --meshes DIR --part all --paired OLD/A.ckpt NEW/A.ckpt
    python bench/held_out.py --table ROWS.json   # only puts rows into docs/results/held_out.csv

The scenes are those that training with data.split={train: 0.8, val: 0.05, test: 0.15} and seed 0
holds out; with --part train, those that it learns from, without augmentation: the difference is
what was learned by heart; with --part all, every one, of a dataset that nothing learned from.
Frames of a scene are alike, so that intervals resample scenes, not images (95 %, percentile
bootstrap). With --out, rows are added to those of the file.

With --paired, each checkpoint but the first of its object also has the difference to that one on
the same images.

Objects that the frame cuts off, and those whose pixels are few, have figures of their own.

ADD-S of few surface points is lower than of many. Files carry 200 or 2,000 of them: all files of an
object are judged by those of the one that carries the most.
"""

import csv
import json
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from marked import format_row
from programs import HOME, make_parser
from scene_bootstrap import bootstrap_scenes

import posefilter
from posefilter.data.frames import FrameRecord, NotShown, Sample
from posefilter.data.readers.registry import open_meshes, open_reader
from posefilter.data.splits import split_records
from posefilter.memory import keep_freed_memory
from posefilter.metrics.errors import add, add_s
from posefilter.metrics.scores import auc, median

ROWS = HOME / "docs" / "results" / "held_out.csv"
SPLIT = {"train": 0.8, "val": 0.05, "test": 0.15}
ALL = "all"
LEAST = 0.3  # visible share
# by whose definition it is; rows of the file that are "in the frame" count no truncation
VISIBILITY = "BOP"
KEYS = ("visibility", "object", "weights", "scenes of", "images")
HEAD = (*KEYS, "scenes", "ADD AUC", "ADD AUC from", "ADD AUC to", "ADD-S AUC", "ADD-S AUC from")
HEAD += ("ADD-S AUC to", "ADD < 0.1 d %", "ADD-S < 0.1 d %", "median mm")
SMALL = 1500  # pixels of the object, of an image of 320 x 240
# the last: whole and of fewer pixels than SMALL
KINDS = {"whole": "in frame", "cut": "truncated", "small": "small"}
HEAD += tuple(f"{k}: {what}" for k in KINDS.values() for what in ("images", "ADD AUC", "ADD-S AUC"))


class Errors(NamedTuple):
    """Of a checkpoint's estimates [m]."""

    plain: torch.Tensor  # (N,) ADD
    symmetric: torch.Tensor  # (N,) ADD-S
    limit: float  # below which an ADD is right


def read_frames(
    root: str,
    meshes: str,
    name: str,
    images: int,
    part: str = "test",
    split: Mapping[str, float] = SPLIT,
) -> list[tuple[str, Sample]]:
    """Return the scene and the sample of evenly chosen frames of a part that show the object."""
    if part == ALL:
        part, split = "test", {"train": 0.0, "val": 0.0, "test": 1.0}
    reader = open_reader("fat", root, None, open_meshes(meshes, None, "fat", [name]))
    records: Sequence[FrameRecord] = reader.records()
    chosen = split_records(records, split, 0, Path(root))[part]
    own = [i for i in chosen if records[i].object == name]
    out = []
    for i in np.random.default_rng(0).permutation(own):  # the objects' folders follow each other
        try:
            sample = reader.read(int(i))
        except NotShown:
            continue
        if reader.visible_share(sample) >= LEAST:
            out.append((records[i].name.rsplit("/", 1)[0], sample))
        if len(out) == images:
            break
    return out


def bound_auc(scenes: Sequence[str], errors: torch.Tensor) -> list[float]:
    """Return the 95 % interval of the AUC when scenes are drawn anew.  (N,) names, (N,) [m]."""
    return [*bootstrap_scenes(scenes, lambda rows: auc(errors[rows]))]


def kind_of(mask: np.ndarray[Any, Any]) -> str:
    """Return whether the frame cuts an object off, and whether it is small.  (H, W) bool."""
    edge = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    if edge.any():
        return "cut"
    return "small" if mask.sum() * (320 * 240 / mask.size) < SMALL else "whole"


def measure_kinds(
    kinds: Sequence[str], plain: torch.Tensor, symmetric: torch.Tensor
) -> dict[str, Any]:
    """Return images, ADD AUC and ADD-S AUC of each kind.  (N,) kinds, (N,) and (N,) errors [m]."""
    out: dict[str, Any] = {}
    for kind in KINDS:
        at = [i for i, one in enumerate(kinds) if one == kind]
        areas = [auc(errors[at]) if at else None for errors in (plain, symmetric)]
        out[kind] = [len(at), *areas]
    return out


def choose_points(checkpoints: Sequence[str]) -> dict[str, torch.Tensor]:
    """Return each object's surface points, of the file that carries the most, (P, 3) [m]."""
    out: dict[str, torch.Tensor] = {}
    for checkpoint in checkpoints:
        model = posefilter.load(checkpoint, device="cpu").object_models[0]
        if len(model.points) > len(out.get(model.name, ())):
            out[model.name] = model.points.double()
    return out


def name_weights(checkpoint: str) -> str:
    """Return what tables call a checkpoint: its run, or the file by itself."""
    path = Path(checkpoint)
    return path.stem if path.parent.name != "checkpoints" else path.parents[1].name


def test(
    checkpoint: str, frames: Sequence[tuple[str, Sample]], points: torch.Tensor
) -> tuple[dict[str, Any], Errors]:
    """Return the row of one checkpoint, and its errors.  points (P, 3) [m]."""
    estimator = posefilter.load(checkpoint, device="cpu")
    model = estimator.object_models[0]
    results = [estimator.predict(s.rgb, s.depth, s.intrinsics) for _, s in frames]
    poses = torch.from_numpy(np.stack([result.pose for result in results]))
    truth = torch.from_numpy(np.stack([s.camera_from_object for _, s in frames])).double()
    scenes = [scene for scene, _ in frames]
    plain, symmetric = (f(poses, truth, points) for f in (add, add_s))
    recall = [float((e < 0.1 * model.diameter).double().mean()) for e in (plain, symmetric)]
    row = {
        "object": model.name,
        "weights": name_weights(checkpoint),
        "images": len(frames),
        "scenes": len(set(scenes)),
        "add_auc": auc(plain),
        "add_interval": bound_auc(scenes, plain),
        "add_s_auc": auc(symmetric),
        "add_s_interval": bound_auc(scenes, symmetric),
        "add_recall": recall[0],
        "add_s_recall": recall[1],
        "median_mm": 1000 * median(plain),
        "kinds": measure_kinds([kind_of(s.mask > 0) for _, s in frames], plain, symmetric),
    }
    return row, Errors(plain, symmetric, 0.1 * model.diameter)


def _gain(a: torch.Tensor, b: torch.Tensor, rows: Sequence[int]) -> float:
    return auc(b[rows]) - auc(a[rows])


def compare(scenes: Sequence[str], first: Errors, other: Errors) -> str:
    """Return by how much the areas of one checkpoint are above another's, and how many of each are
    right.

    scenes: (N,) names, of each image.
    """
    cells = []
    for a, b in ((first.plain, other.plain), (first.symmetric, other.symmetric)):
        low, high = bootstrap_scenes(scenes, partial(_gain, a, b))
        cells.append(f"{auc(b) - auc(a):+.1f} [{low:.1f}, {high:.1f}]")
    right = [int((one.plain < one.limit).sum()) for one in (first, other)]
    return format_row(["difference: ADD AUC, ADD-S AUC, right", *cells, "{}, {}".format(*right)])


def make_line(row: dict[str, Any]) -> str:
    """Return a row for people: object, weights, images, scenes, areas, recalls, median."""
    areas = [
        f"{row[name + '_auc']:.1f} ({row[name + '_interval'][0]:.0f} to "
        f"{row[name + '_interval'][1]:.0f})"
        for name in ("add", "add_s")
    ]
    shares = [f"{100 * row[name]:.0f}" for name in ("add_recall", "add_s_recall")]
    first = [row["object"], f"`{row['weights']}`", str(row["images"]), str(row["scenes"])]
    cells = [*first, *areas, *shares, f"{row['median_mm']:.1f}"]
    return format_row(cells)


def make_part_line(row: dict[str, Any]) -> str:
    """Return a row for people: object, weights, part, and the figures of each kind of image."""
    cells = [row["object"], f"`{row['weights']}`", row["part"], str(row["images"])]
    for kind in KINDS:
        count, *areas = row["kinds"][kind]
        cells += [str(count), *("–" if area is None else f"{area:.1f}" for area in areas)]
    return format_row(cells)


def make_cells(row: dict[str, Any]) -> list[str]:
    """Return a row of the file."""
    cells = [VISIBILITY, row["object"], row["weights"], row["part"], row["images"], row["scenes"]]
    for name in ("add", "add_s"):
        cells.append(f"{row[name + '_auc']:.1f}")
        cells += [f"{end:.0f}" for end in row[name + "_interval"]]
    cells += [f"{100 * row[name]:.0f}" for name in ("add_recall", "add_s_recall")]
    cells.append(f"{row['median_mm']:.1f}")
    for kind in KINDS:
        count, *areas = row["kinds"][kind]
        cells += [count, *("" if area is None else f"{area:.1f}" for area in areas)]
    return [str(cell) for cell in cells]


def write_rows(rows: Sequence[dict[str, Any]], path: Path = ROWS) -> None:
    """Put rows into the file: those of the same first cells are replaced, others stay."""
    with path.open(newline="") as file:
        old = list(csv.reader(file))[1:]
    kept = {tuple(cells[: len(KEYS)]): cells for cells in [*old, *map(make_cells, rows)]}
    with path.open("w", newline="") as file:
        lines = [HEAD, *(kept[key] for key in sorted(kept))]
        csv.writer(file, lineterminator="\n").writerows(lines)


def main() -> int:
    """Test the checkpoints, or write their rows down."""
    parser = make_parser(__doc__)
    parser.add_argument("checkpoints", nargs="*")
    parser.add_argument("--root", help="a dataset of bench/photographs.py, in FAT's format")
    parser.add_argument("--meshes", help="its meshes")
    parser.add_argument("--images", type=int, default=48)
    parser.add_argument("--part", default="test", choices=[*SPLIT, ALL])
    parser.add_argument("--paired", action="store_true")
    parser.add_argument("--out", type=Path, help="a file that the rows are added to")
    parser.add_argument("--table", type=Path, help=f"a file of rows to put into {ROWS.name}")
    options = parser.parse_args()
    if options.table:
        write_rows(json.loads(options.table.read_text()))
        return 0
    if not (options.root and options.meshes and options.checkpoints):
        parser.error("--root, --meshes and a checkpoint are needed")
    torch.set_num_threads(1)
    keep_freed_memory()
    points = choose_points(options.checkpoints)
    frames: dict[str, list[tuple[str, Sample]]] = {}
    firsts: dict[str, Errors] = {}
    for checkpoint in options.checkpoints:
        name = posefilter.load(checkpoint, device="cpu").objects[0]
        if name not in frames:
            where = (options.root, options.meshes)
            frames[name] = read_frames(*where, name, options.images, options.part)
        row, errors = test(checkpoint, frames[name], points[name])
        row |= {"part": options.part}
        print(make_line(row), make_part_line(row), sep="\n", flush=True)
        first = firsts.setdefault(name, errors)
        if options.paired and first is not errors:
            print(compare([scene for scene, _ in frames[name]], first, errors), flush=True)
        if options.out:
            rows = json.loads(options.out.read_text()) if options.out.is_file() else []
            options.out.write_text(json.dumps([*rows, row], indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
