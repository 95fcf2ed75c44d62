"""Filters against methods that are none: accuracy over the number of training images and clutter.

    python bench/comparisons.py [--only learning_curve|clutter|tables] [--list] [KEY=VALUE ...]

Trains two filters and two comparisons on rendered scenes, each with the same number of steps and
images a step, on growing parts of one training set; then tests those of 1,000 images on scenes with
more and more distractors. The sizes that tell most come first. Started again, it goes on where it
was stopped. What is typed beyond the options, such as threads=1, is handed to every command. Last,
the rows of docs/results/runs.csv are written, and the tables of docs/results/comparisons.md.
"""

import argparse
import json
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from marked import format_row, put_table

from posefilter.metrics.image_errors import FILE, ImageError, read_errors
from posefilter.metrics.scores import auc, recall

HOME = Path(__file__).parents[1]
ROOT = Path("outputs/comparisons")
PAGE = HOME / "docs" / "results" / "comparisons.md"
MODELS = ("dense_coordinates", "keypoints", "patch_pf", "pose_pf")
GROUPS = ("patch_pf,dense_coordinates", "keypoints", "pose_pf")
SIZES, MOST = ("50,1000", "200", "100,400"), 1000
SCENES = "data.generate.frames=1600 data.split={train:0.7,val:0.1,test:0.2}"
STEPS = "trainer.max_steps=300 trainer.val_check_interval=300 scheduler.warmup_steps=30"
# half of the preset's particles and no mean shift, for time: it changes the test alone
SMALL = (
    "filter.particles=100 filter.first_particles=200 filter.steps=8 filter/refine=rescore "
    "data/augment=strong"  # as the others have it
)
DISTRACTORS = (0, 8, 16)
VISIBLE = ((0.3, 0.5), (0.5, 0.8), (0.8, 1.01))
RESAMPLED = 2000  # bootstrap samples of the scenes
Table = tuple[list[str], list[str]]  # headings, and lines


class Tested(NamedTuple):
    """A method's test: one row an image."""

    model: str
    at: int  # training images, or distractors
    rows: list[ImageError]


def list_trainings() -> list[str]:
    """Return the command lines of the learning curve, the most telling first."""
    lines = []
    for sizes, models in product(SIZES, GROUPS):
        few = f"data.limit_train={sizes} data.limit_val=20 data.limit_test=100"
        common = f"sweep=learning_curve {SCENES} {few} {STEPS} seed=0"
        small = f" {SMALL}" if models == "pose_pf" else ""
        out = f"out={ROOT / 'learning_curve'} console=json"
        lines += [f"train.py -m model={models}{small} {common} {out}"]
    return lines


def list_evaluations() -> list[str]:
    """Return the command lines of the clutter, for the runs of 1,000 images that there are."""
    lines = []
    for folder, model, size in find_runs(ROOT / "learning_curve"):
        for count in DISTRACTORS if size == MOST else ():
            out = ROOT / "clutter" / f"{model}_{count}"
            if (HOME / out / "metrics.json").is_file():
                continue
            scenes = (
                f"data=scenes data.root=outputs/data/carton_clutter_{count} data.object=carton "
                f"data.generate.frames=60 data.generate.frames_per_scene=2 "
                f"data.generate.seed={1000 + count} data.generate.distractors=[{count},{count}] "
                "data.generate.occluded_share=0 data.split={train:1.0,val:train,test:train}"
            )
            checkpoint = str(folder / "checkpoints" / "best.ckpt")
            checkpoint = checkpoint.replace("=", r"\=").replace(",", r"\,")
            lines += [f"evaluate.py checkpoint={checkpoint} {scenes} out={out} console=json"]
    return lines


def find_runs(root: Path) -> Iterator[tuple[Path, str, int]]:
    """Yield folder, method and number of training images of each finished run."""
    for file in sorted((HOME / root).glob("*/metrics.json")):
        metrics = json.loads(file.read_text())
        typed = dict(text.split("=", 1) for text in metrics["overrides"] if "=" in text)
        if "data.limit_train" in typed:
            yield file.parent.relative_to(HOME), metrics["model"], int(typed["data.limit_train"])


def read_tests() -> tuple[list[Tested], list[Tested]]:
    """Return the tests of the learning curve, and those of the clutter."""
    curve, clutter = [], []
    for folder, model, size in find_runs(ROOT / "learning_curve"):
        curve.append(Tested(model, size, read_errors(HOME / folder / FILE)))
    for file in sorted((HOME / ROOT / "clutter").glob(f"*/{FILE}")):
        model, _, count = file.parent.name.rpartition("_")
        clutter.append(Tested(model, int(count), read_errors(file)))
    return curve, clutter


def measure_auc(rows: Sequence[ImageError]) -> float:
    """Return the area under the ADD curve."""
    return auc(torch.tensor([row.add_mm for row in rows], dtype=torch.float64) / 1000)


def measure_recall(rows: Sequence[ImageError]) -> float:
    """Return the share of images with an ADD below a tenth of the diameter [%]."""
    errors, diameters = (
        torch.tensor([getattr(row, name) for row in rows]) for name in ("add_mm", "diameter_mm")
    )
    return recall(errors, 0.1 * diameters)


def bootstrap(rows: Sequence[ImageError], measure: Callable[[Sequence[ImageError]], float]) -> str:
    """Return a figure and its 95 % interval over scenes drawn with replacement."""
    scenes: dict[int, list[ImageError]] = {}
    for row in rows:
        scenes.setdefault(row.scene_id, []).append(row)
    groups, generator = list(scenes.values()), np.random.default_rng(0)
    drawn = generator.integers(len(groups), size=(RESAMPLED, len(groups)))
    values = [measure([row for i in one for row in groups[i]]) for one in drawn]
    low, high = np.percentile(values, [2.5, 97.5])
    return f"{measure(rows):.1f} [{low:.0f}, {high:.0f}]"


def tabulate(
    tests: Sequence[Tested],
    columns: Sequence[int],
    measure: Callable[[Sequence[ImageError]], float],
) -> Table:
    """Return a row a method and a column a setting; a dash where there is no test."""
    found = {(test.model, test.at): bootstrap(test.rows, measure) for test in tests}
    rows = [format_row([f"`{m}`", *[found.get((m, at), "–") for at in columns]]) for m in MODELS]
    return ["", *[f"{at:,}" for at in columns]], rows


def tabulate_visibility(tests: Sequence[Tested]) -> Table:
    """Return a row a method trained on the most images, and a column a range of visibility."""
    rows, counts = [], [0] * len(VISIBLE)
    for model in MODELS:
        cells = ["–"] * len(VISIBLE)
        for test in tests:
            if (test.model, test.at) == (model, MOST):
                parts = [
                    [r for r in test.rows if low <= r.visibility < high] for low, high in VISIBLE
                ]
                cells = [bootstrap(part, measure_auc) if part else "–" for part in parts]
                counts = [len(part) for part in parts]
        rows.append(format_row([f"`{model}`", *cells]))
    head = [
        f"{low:g} to {min(high, 1):g} ({count} images)"
        for (low, high), count in zip(VISIBLE, counts, strict=True)
    ]
    return ["", *head], rows


def write_tables() -> None:
    """Write the tables of the page, and the runs' rows."""
    curve, clutter = read_tests()
    sizes = sorted(int(size) for part in SIZES for size in part.split(","))
    tables = {
        "auc": tabulate(curve, sizes, measure_auc),
        "recall": tabulate(curve, sizes, measure_recall),
        "visibility": tabulate_visibility(curve),
        "distractors": tabulate(clutter, DISTRACTORS, measure_auc),
    }
    page = PAGE.read_text()
    for title, (head, rows) in tables.items():
        page = put_table(page, title, head, rows)
    PAGE.write_text(page)


def main() -> int:
    """Run the plan; the status is that of the worst command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("more", nargs="*")
    parser.add_argument("--only", choices=("learning_curve", "clutter", "tables"))
    parser.add_argument("--list", action="store_true", help="print the commands, run nothing")
    options = parser.parse_args()
    worst = 0
    for name, list_lines in (("learning_curve", list_trainings), ("clutter", list_evaluations)):
        for line in list_lines() if options.only in (None, name) else []:
            words = [*line.split(), *options.more]
            print(f"$ python {shlex.join(words)}", flush=True)
            if not options.list:
                done = subprocess.run([sys.executable, *words], cwd=HOME, check=False)
                worst = max(worst, done.returncode)
    if not options.list and options.only in (None, "tables"):
        write_tables()
        collect = [sys.executable, "bench/collect_runs.py", str(ROOT)]
        worst = max(worst, subprocess.run(collect, cwd=HOME, check=False).returncode)
    return worst


if __name__ == "__main__":
    sys.exit(main())
