"""Test checkpoints on photographs that were altered: camera rolled, zoomed, object occluded, color
changed.

    python bench/altered_photographs.py --frames DIR --meshes DIR [--images 24] [--out ROWS.json]
        A.ckpt [B.ckpt ...] [--only CHANGE ...]
    python bench/altered_photographs.py ... --sensors        # the depth as other sensors give it
    python bench/altered_photographs.py --table ROWS.json    # only writes rows into photographs.md

A folder of few photographs shows an object in few poses, in one place and one light. Each change is
exact for RGB-D images, so that pose and intrinsics stay true: the camera turns about its optical
axis, its focal length changes, a piece of another sequence's photograph is put in front, colors are
those of another camera. Frames are evenly spaced over each sequence. What is drawn depends on the
number of the image alone: all checkpoints of an object see the same images.
"""

import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from depth_sensors import SENSORS
from held_out import choose_points, name_weights
from marked import format_row, put_table, read_rows
from numpy.random import Generator
from programs import HOME, make_parser

import posefilter
from posefilter.data.augmentation import Augment, Compose, Draw, PasteOccluder, RollAndZoom
from posefilter.data.frames import FrameRecord, Sample
from posefilter.data.photometric import ColorResponse
from posefilter.data.readers.base import BaseReader
from posefilter.data.readers.registry import open_meshes, open_reader
from posefilter.memory import keep_freed_memory
from posefilter.metrics.errors import add, add_s, add_up_to_symmetry
from posefilter.metrics.scores import auc

PAGE = HOME / "docs" / "results" / "photographs.md"
VIEWS = 4  # photographs of a sequence that are altered
SCRAPS = 6  # photographs of other sequences that occluders are cut from
HEAD = ("object", "weights", "change", "images", "ADD AUC", "ADD-S AUC", "ADD < 0.1 d %")
HEAD += ("ADD-S < 0.1 d %", "found %", "found and wrong")
_AREAS = ("add_auc", "add_s_auc")

_OCCLUDER = PasteOccluder(probability=1.0, size=(0.05, 0.16), keep=0.35)
CHANGES: dict[str, Augment] = {
    "none": Compose([]),
    "roll": RollAndZoom(0.0, 1.0, (1.0, 1.0), 0.8),
    "far": RollAndZoom(0.0, 0.0, (0.5, 0.8), 0.8),
    "occluded": Compose([_OCCLUDER, _OCCLUDER]),
    "color": ColorResponse(hue_deg=16, mixing=0.14, tint=0.14, gamma=0.35),
    "all": Compose(
        [
            _OCCLUDER,
            RollAndZoom(0.0, 1.0, (0.6, 1.3), 0.8),
            ColorResponse(hue_deg=12, mixing=0.1, tint=0.1, gamma=0.25),
        ]
    ),
}


def choose_views(records: Sequence[FrameRecord], name: str) -> list[int]:
    """Return evenly spaced records of an object, VIEWS of each of its sequences."""
    groups: dict[str, list[int]] = {}
    for i, record in enumerate(records):
        if record.object == name:
            groups.setdefault(record.group, []).append(i)
    return [own[k * len(own) // VIEWS] for own in groups.values() for k in range(VIEWS)]


def read_scraps(reader: BaseReader, records: Sequence[FrameRecord], group: str) -> list[Sample]:
    """Return samples of other sequences than `group`."""
    others = [i for i, record in enumerate(records) if record.group != group]
    return [reader.read(i) for i in others[:: max(len(others) // SCRAPS, 1)]]


def alter(
    views: Sequence[tuple[Sample, Sequence[Sample]]], change: str, images: int
) -> list[Sample]:
    """Return altered photographs, in turn of each view; each comes with what to cut from."""

    def draw_from(scraps: Sequence[Sample]) -> Draw:
        def draw(rng: Generator) -> Sample:
            return scraps[int(rng.integers(len(scraps)))]

        return draw

    out = []
    for k in range(images):
        view, scraps = views[k % len(views)]
        rng = np.random.default_rng([k, 7])
        out.append((CHANGES | SENSORS)[change](view, draw_from(scraps), rng))
    return out


def test(
    estimator: posefilter.Estimator, samples: Sequence[Sample], points: torch.Tensor
) -> dict[str, Any]:
    """Return the figures of one checkpoint on samples.  points (P, 3) [m]."""
    results = [estimator.predict(s.rgb, s.depth, s.intrinsics) for s in samples]
    poses = torch.from_numpy(np.stack([result.pose for result in results]))
    truth = torch.from_numpy(np.stack([s.camera_from_object for s in samples])).double()
    plain, symmetric = (f(poses, truth, points) for f in (add, add_s))
    model = estimator.object_models[0]
    least = 0.1 * model.diameter
    nearest = add_up_to_symmetry(poses, truth, points, model.symmetries.double())
    found = torch.tensor([result.verdict == "found" for result in results])
    return {
        "images": len(samples),
        "add_auc": auc(plain),
        "add_s_auc": auc(symmetric),
        "add_recall": float((plain < least).double().mean()),
        "add_s_recall": float((symmetric < least).double().mean()),
        "found": float(found.double().mean()),
        "found_wrong": int((found & (nearest >= least)).sum()),
        "add_mm": (1000 * plain).tolist(),
        "add_s_mm": (1000 * symmetric).tolist(),
    }


def make_line(row: dict[str, Any]) -> str:
    """Return a row of the table."""
    areas = [f"{row[key]:.1f}" for key in _AREAS]
    shares = [f"{100 * row[key]:.0f}" for key in ("add_recall", "add_s_recall", "found")]
    first = [row["object"], f"`{row['weights']}`", row["change"], str(row["images"])]
    return format_row([*first, *areas, *shares, str(row["found_wrong"])])


def make_wide_line(rows: Sequence[dict[str, Any]], changes: Iterable[str]) -> str:
    """Return a row of a table of the page: one file's figures for every change."""
    cells = [rows[0]["object"], rows[0]["weights"]]
    for change in changes:
        own = [row for row in rows if row["change"] == change]
        cells.append(" / ".join(f"{own[-1][key]:.1f}" for key in _AREAS) if own else "–")
    found = sum(row["found_wrong"] for row in rows), sum(row["images"] for row in rows)
    return format_row([*cells, f"{found[0]} of {found[1]}"])


def write_table(rows: Sequence[dict[str, Any]], page: Path = PAGE) -> None:
    """Put rows into the page's tables: those of the same object and weights are replaced."""
    text = page.read_text()
    for title, changes in (("altered", list(CHANGES)), ("sensors", list(SENSORS))):
        files = dict[tuple[str, str], list[dict[str, Any]]]()
        # of a change that was tested twice, the later
        once = {(row["object"], row["weights"], row["change"]): row for row in rows}
        for row in once.values():
            if row["change"] in changes:
                files.setdefault((row["object"], row["weights"]), []).append(row)
        if not files:
            continue
        lines = [*read_rows(text, title), *(make_wide_line(f, changes) for f in files.values())]
        kept = {tuple(line.split(" | ")[:2]): line for line in lines}
        head = ("object", "weights", *changes, "found and wrong")
        text = put_table(text, title, head, (kept[key] for key in sorted(kept)))
    page.write_text(text)


def main() -> int:
    """Test the checkpoints on every kind of change."""
    parser = make_parser(__doc__)
    parser.add_argument("checkpoints", nargs="*")
    parser.add_argument("--frames", help="a folder of YCB-Video")
    parser.add_argument("--meshes", help="its meshes")
    parser.add_argument("--images", type=int, default=24, help="of each kind of change")
    parser.add_argument("--sensors", action="store_true", help="changes of the depth alone")
    parser.add_argument("--only", nargs="+", choices=[*CHANGES, *SENSORS])
    parser.add_argument("--out", type=Path, help="a file that the rows are added to")
    parser.add_argument("--table", type=Path, help="a file of rows to write into the page")
    options = parser.parse_args()
    if options.table:
        write_table(json.loads(options.table.read_text()))
        return 0
    if not (options.frames and options.meshes and options.checkpoints):
        parser.error("--frames, --meshes and a checkpoint are needed")
    torch.set_num_threads(1)
    keep_freed_memory()
    points = choose_points(options.checkpoints)
    meshes = open_meshes(options.meshes, None, "ycb_video", list(points))
    reader = open_reader("ycb_video", options.frames, None, meshes)
    records = reader.records()
    rows = []
    for checkpoint in options.checkpoints:
        estimator = posefilter.load(checkpoint, device="cpu")
        name = estimator.object_models[0].name
        views = [
            (reader.read(i), read_scraps(reader, records, records[i].group))
            for i in choose_views(records, name)
        ]
        if not views:
            print(f"{options.frames}: no photograph shows {name}", file=sys.stderr)
            continue
        weights = name_weights(checkpoint)
        for change in options.only or (SENSORS if options.sensors else CHANGES):
            samples = alter(views, change, len(views) if change == "none" else options.images)
            tested = test(estimator, samples, points[name])
            rows.append({"object": name, "weights": weights, "change": change, **tested})
            print(make_line(rows[-1]), flush=True)
    if options.out:
        before = json.loads(options.out.read_text()) if options.out.exists() else []
        options.out.write_text(json.dumps(before + rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
