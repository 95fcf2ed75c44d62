"""Compare the filter with and without Markov moves and niches on rendered frames: time, coverage
of the credible sets, and log density of the truth.

    python bench/moves.py --root DIR --meshes DIR [--frames 60] [--minutes 3] [--out FILE.json]
        FILE.ckpt ...

Every way runs on each frame in turn, so that the times of one run compare; each file has its share
of the minutes.  The first frame of each file is not counted: it warms up.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from checkpoint_frames import open_frames
from marked import format_table
from programs import HOME, make_parser

from posefilter.cli.checkpoints import method_of, read_checkpoint
from posefilter.cli.command import compose_job
from posefilter.cli.components import changes
from posefilter.data.absent import hide_annotation
from posefilter.data.loaders import make_loader
from posefilter.metrics.credibility import SHOWN, measure_coverage, score_truth
from posefilter.types import Batch

MOVES = "filter/refine=mean_shift_and_resample_move"
WAYS = {"default": [], "moves": [MOVES], "niches, moves": ["filter/resample=niches", MOVES]}
HEAD = ["way", "frames", "seconds, median", "over the default", "coverage of credible sets"]
HEAD += ["log density, mean", "median"]


def measure(file: str, options: Any, end: float) -> list[dict[str, Any]]:
    """Return a row a frame and way."""
    checkpoint, methods = read_checkpoint(file), {}
    for way, words in WAYS.items():
        job = compose_job("predict", HOME / "conf", [f"checkpoint={file}", *words], Path())
        methods[way] = method_of(checkpoint, changes(job.cfg), lightning=False)
        methods[way].seed = 0
    name = methods["default"].object_model.name
    data = open_frames(file, checkpoint, name, options)
    rows = []
    for number, batch in enumerate(make_loader(data.val_dataset, 1, 0)):
        if time.monotonic() > end:
            break
        seen = Batch(*hide_annotation(batch))
        for way, method in methods.items():
            start = time.perf_counter()
            with torch.no_grad():
                belief = method.predict_step(seen, number).belief
            seconds = time.perf_counter() - start
            scores = score_truth(belief, batch.camera_from_object, method.object_model)
            row = {"object": name, "way": way, "number": number, "seconds": seconds}
            row |= {"rank": float(scores.rank), "log_density": float(scores.log_density)}
            rows.append(row)
    return rows


def tabulate(rows: list[dict[str, Any]]) -> str:
    """Return a Markdown table, a row a way."""
    counted = [row for row in rows if row["number"] > 0]
    lines = []
    usual = np.median([row["seconds"] for row in counted if row["way"] == "default"])
    for way in WAYS:
        own = [row for row in counted if row["way"] == way]
        rank = torch.tensor([row["rank"] for row in own])
        shares = (f"{100 * measure_coverage(rank, level / 100):.0f}" for level in SHOWN)
        density = np.array([row["log_density"] for row in own])
        seconds = np.median([row["seconds"] for row in own])
        cells = [way, str(len(own)), f"{seconds:.2f}", f"{seconds / usual:.1f}", " / ".join(shares)]
        lines.append([*cells, f"{density.mean():.2f}", f"{np.median(density):.2f}"])
    return format_table(HEAD, lines)


def main() -> int:
    """Print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("files", nargs="+")
    parser.add_argument("--root", required=True)
    parser.add_argument("--meshes", required=True)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    start, rows = time.monotonic(), []
    for k, file in enumerate(options.files, start=1):
        rows += measure(file, options, start + 60 * options.minutes * k / len(options.files))
        if options.out is not None:
            options.out.write_text(json.dumps(rows))
    print(tabulate(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
