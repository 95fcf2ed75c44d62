"""Test checkpoints of one object on the same held-out renders, with intervals over scenes.

    python bench/held_out.py --root DIR --meshes DIR [--images 48] [--out ROWS.json] \
        A.ckpt [B.ckpt ...]
    python bench/held_out.py --table ROWS.json     # only rewrites the table of photographs.md

The scenes are those that training with data.split={train: 0.8, val: 0.05, test: 0.15} and seed 0
holds out. Frames of a scene are alike, so that intervals resample scenes, not images (95 %,
percentile bootstrap). With --out, rows are added to those of the file.

Errors are of the surface points that a checkpoint carries, 200 in those that ship. ADD-S of few
points is lower than of many: compare files that carry as many.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

import posefilter
from posefilter.cli.machine import keep_freed_memory
from posefilter.data.frames import FrameRecord, NotShown, Sample
from posefilter.data.readers.registry import open_meshes, open_reader
from posefilter.data.splits import split_records
from posefilter.metrics.errors import add, add_s
from posefilter.metrics.scores import auc

HOME = Path(__file__).parents[1]
PAGE = HOME / "docs" / "results" / "photographs.md"
MARK, END = "<!-- table: held-out -->", "<!-- end -->"
SPLIT = {"train": 0.8, "val": 0.05, "test": 0.15}
LEAST = 0.3  # visible share
HEAD = ("object", "weights", "images", "scenes", "ADD AUC", "ADD-S AUC", "ADD < 0.1 d %")
HEAD += ("ADD-S < 0.1 d %", "median mm")


def read_held_out(root: str, meshes: str, name: str, images: int) -> list[tuple[str, Sample]]:
    """Return the scene and the sample of evenly chosen held-out frames that show the object."""
    reader = open_reader("fat", root, None, open_meshes(meshes, None, "fat", [name]))
    records: Sequence[FrameRecord] = reader.records()
    held_out = split_records(records, SPLIT, 0, Path(root))["test"]
    own = [i for i in held_out if records[i].object == name]
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


def bootstrap(scenes: Sequence[str], errors: torch.Tensor, draws: int = 1000) -> list[float]:
    """Return the 95 % interval of the AUC when scenes are drawn anew.  (N,) names, (N,) [m]."""
    names = sorted(set(scenes))
    rows = [[i for i, scene in enumerate(scenes) if scene == name] for name in names]
    rng = np.random.default_rng(0)
    found = []
    for _ in range(draws):
        chosen = rng.integers(len(names), size=len(names))
        found.append(auc(errors[[i for one in chosen for i in rows[one]]]))
    return [float(x) for x in np.percentile(found, [2.5, 97.5])]


def test(checkpoint: str, frames: Sequence[tuple[str, Sample]]) -> dict[str, Any]:
    """Return the row of one checkpoint."""
    estimator = posefilter.load(checkpoint, device="cpu")
    model = estimator.models[0]
    results = [estimator.predict(s.rgb, s.depth, s.intrinsics) for _, s in frames]
    poses = torch.from_numpy(np.stack([result.pose for result in results]))
    truth = torch.from_numpy(np.stack([s.camera_from_object for _, s in frames])).double()
    scenes = [scene for scene, _ in frames]
    plain, symmetric = (f(poses, truth, model.points.double()) for f in (add, add_s))
    recall = [float((e < 0.1 * model.diameter).double().mean()) for e in (plain, symmetric)]
    path = Path(checkpoint)
    name = path.stem if path.parent.name != "checkpoints" else path.parents[1].name
    return {
        "object": model.name,
        "weights": name,
        "images": len(frames),
        "scenes": len(set(scenes)),
        "add_auc": auc(plain),
        "add_interval": bootstrap(scenes, plain),
        "add_s_auc": auc(symmetric),
        "add_s_interval": bootstrap(scenes, symmetric),
        "add_recall": recall[0],
        "add_s_recall": recall[1],
        "median_mm": 1000 * float(plain.median()),
    }


def make_line(row: dict[str, Any]) -> str:
    """Return a row of the table."""
    areas = [
        f"{row[name + '_auc']:.1f} ({row[name + '_interval'][0]:.0f} to "
        f"{row[name + '_interval'][1]:.0f})"
        for name in ("add", "add_s")
    ]
    shares = [f"{100 * row[name]:.0f}" for name in ("add_recall", "add_s_recall")]
    first = [row["object"], f"`{row['weights']}`", str(row["images"]), str(row["scenes"])]
    cells = [*first, *areas, *shares, f"{row['median_mm']:.1f}"]
    return f"| {' | '.join(cells)} |"


def write_table(rows: Sequence[dict[str, Any]], page: Path = PAGE) -> None:
    """Put the rows into the page, by object."""
    before, rest = page.read_text().split(MARK, 1)
    _, after = rest.split(END, 1)
    head = [f"| {' | '.join(cells)} |" for cells in (HEAD, ["---"] * len(HEAD))]
    lines = [make_line(row) for row in sorted(rows, key=lambda row: str(row["object"]))]
    page.write_text(before + "\n".join([MARK, *head, *lines, END]) + after)


def main() -> int:
    """Test the checkpoints, or write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoints", nargs="*")
    parser.add_argument("--root", help="a dataset of bench/photographs.py, in FAT's format")
    parser.add_argument("--meshes", help="its meshes")
    parser.add_argument("--images", type=int, default=48)
    parser.add_argument("--out", type=Path, help="a file that the rows are added to")
    parser.add_argument("--table", type=Path, help="a file of rows to write into the page")
    options = parser.parse_args()
    if options.table:
        write_table(json.loads(options.table.read_text()))
        return 0
    if not (options.root and options.meshes and options.checkpoints):
        parser.error("--root, --meshes and a checkpoint are needed")
    torch.set_num_threads(1)
    keep_freed_memory()
    frames: dict[str, list[tuple[str, Sample]]] = {}
    for checkpoint in options.checkpoints:
        name = posefilter.load(checkpoint, device="cpu").objects[0]
        if name not in frames:
            frames[name] = read_held_out(options.root, options.meshes, name, options.images)
        row = test(checkpoint, frames[name])
        print(make_line(row), flush=True)
        if options.out:
            rows = json.loads(options.out.read_text()) if options.out.is_file() else []
            options.out.write_text(json.dumps([*rows, row], indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
