"""Filters against methods that are none: accuracy over the number of training images, the time of
training, and clutter.

    python bench/comparisons.py [--list] [--only PIECE] [--model NAME] [--tiny] [KEY=VALUE ...]

The plan's pieces, the most telling first, train the five methods and three comparisons on rendered
scenes: with the same number of steps and images a step, or for the same processor time, on growing
parts of one training set; and test those of 1,000 images on scenes with more and more distractors.
`--list` prints the commands with what each is to take on one thread. `--only` and `--model` may be
repeated; `--only tables` runs nothing. Started again, it goes on where it was stopped. What is
typed beyond the options, such as threads=1, is handed to every command. After each piece the rows
of docs/results/runs.csv are written, and the tables of docs/results/comparisons.md, where cells of
what did not run stay; with `--tiny`, which checks that all pieces run, both are copies in the runs'
own folder.
"""

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from marked import format_row, put_table, read_rows, split_row
from programs import HOME, make_parser, run_command

from posefilter.metrics.image_errors import FILE, ImageError, read_errors
from posefilter.metrics.scores import auc, recall

ROOT, TINY_ROOT = Path("outputs/comparisons"), Path("outputs/comparisons_tiny")
PAGE = HOME / "docs" / "results" / "comparisons.md"
POSED = ("dense_coordinates", "rotation_grid", "patch_pf", "pixel_pf", "keypoints", "pose_pf")
DETECTORS = ("cnn_patch", "downsized")
IN_IMAGE = ("patch_pf", "pixel_pf", *DETECTORS)  # their particles are positions in the image
MODELS = (*POSED, *DETECTORS)
SIZES, MOST = (50, 100, 200, 400, 1000), 1000
VALIDATED, TESTED = 20, 100  # images
SCENES = (
    "data.generate.frames=1600 data.split={train:0.7,val:0.1,test:0.2} "
    f"data.limit_val={VALIDATED} data.limit_test={TESTED}"
)
STEPS, TIME = 300, 120  # steps, and seconds of processor time, of a training
SCHEDULES = {
    "learning_curve": f"trainer.max_steps={STEPS} trainer.val_check_interval={STEPS} "
    "scheduler.warmup_steps=30",
    "learning_time": f"callbacks.budget.seconds={TIME}",
}
# half of the preset's particles and no mean shift, for time: it changes the test alone
OF_MODEL = {
    "pose_pf": "filter.particles=100 filter.initial_particles=200 filter.steps=8 "
    "filter/refine=rescore data/augment=strong"  # as the others have it
}
DISTRACTORS, CLUTTERED = (0, 8, 16), 60  # images each
VISIBLE = ((0.3, 0.5), (0.5, 0.8), (0.8, 1.01))
RESAMPLED = 2000  # bootstrap samples
TINY = (
    "data.generate.frames=30 data.generate.size=[160,120] data.generate.workers=1 "
    "data.image_width=160 data.limit_val=2 data.limit_test=4 data.num_model_points=500 "
    "filter.particles=8 filter.initial_particles=null"
)
TINY_SCHEDULES = {
    "learning_curve": "trainer.max_steps=2 trainer.val_check_interval=2",
    "learning_time": "callbacks.budget.seconds=3 trainer.max_steps=8 trainer.val_check_interval=8",
}
Table = tuple[list[str], list[str]]  # headings, and lines


class Cost(NamedTuple):
    """Processor time of a method, with one thread [s]."""

    step: float  # of 8 images
    image: float  # of a test


# of 5 steps of 8 images and a test of 8, without metrics, on one thread; of the last three from
# their ratio to patch_pf on another machine
COSTS = {
    "dense_coordinates": Cost(0.16, 0.02),
    "rotation_grid": Cost(0.15, 0.70),
    "patch_pf": Cost(0.17, 0.02),
    "keypoints": Cost(0.21, 0.02),
    "pose_pf": Cost(0.26, 0.07),
    "pixel_pf": Cost(0.17, 0.02),
    "cnn_patch": Cost(0.25, 0.03),
    "downsized": Cost(0.23, 0.03),
}
METRICS = 0.1  # [s] of an image
START = 12.0  # [s] of processor time of a run without its steps and images


class Piece(NamedTuple):
    """Trainings that are compared with each other, or tests of them with distractors."""

    name: str
    table: str  # and folder
    sizes: tuple[int, ...] = (MOST,)
    seeds: tuple[int, ...] = (0,)


# what tells most, for its time, comes first
PLAN = (
    Piece("many", "learning_curve", (1000,)),
    Piece("few", "learning_curve", (50,)),
    Piece("distractors", "clutter"),
    Piece("many_in_time", "learning_time", (1000,)),
    Piece("few_in_time", "learning_time", (50,)),
    Piece("few_seeds", "learning_curve", (50,), (1, 2)),
    Piece("many_seeds", "learning_curve", (1000,), (1, 2)),
    Piece("distractors_seeds", "clutter", (MOST,), (1, 2)),
    Piece("some", "learning_curve", (200,)),
    Piece("some_in_time", "learning_time", (200,)),
    Piece("between", "learning_curve", (100, 400)),
    Piece("some_seeds", "learning_curve", (200,), (1, 2)),
    Piece("few_in_time_seeds", "learning_time", (50,), (1, 2)),
    Piece("many_in_time_seeds", "learning_time", (1000,), (1, 2)),
    Piece("some_in_time_seeds", "learning_time", (200,), (1, 2)),
    Piece("between_seeds", "learning_curve", (100, 400), (1, 2)),
    Piece("between_in_time", "learning_time", (100, 400), (0, 1, 2)),
)


class Run(NamedTuple):
    """A finished run."""

    folder: Path
    model: str
    size: int  # training images
    seed: int


class Tested(NamedTuple):
    """A method's test: one row an image."""

    model: str
    at: int  # training images, or distractors
    seed: int
    rows: list[ImageError]


def list_lines(piece: Piece, models: Sequence[str] = MODELS, tiny: bool = False) -> list[str]:
    """Return the commands of a piece: a sweep a method; tests only of runs that there are."""
    root = TINY_ROOT if tiny else ROOT
    if piece.table == "clutter":
        return [
            line
            for run in find_runs(root / "learning_curve")
            if run.size in piece.sizes and run.seed in piece.seeds and run.model in models
            for line in list_tests(run, root, tiny)
        ]
    return [write_training(piece, model, root, tiny) for model in models]


def write_training(piece: Piece, model: str, root: Path, tiny: bool) -> str:
    """Return the sweep of one method over a piece's sizes and seeds."""
    sizes, seeds = (",".join(map(str, values)) for values in (piece.sizes, piece.seeds))
    words = [f"train.py -m model={model} sweep={piece.table} data.limit_train={sizes} seed={seeds}"]
    if tiny:
        words += [TINY, TINY_SCHEDULES[piece.table], f"data.root={root / 'scenes'}"]
    else:
        words += [*OF_MODEL.get(model, "").split(), SCENES, SCHEDULES[piece.table]]
    return " ".join([*words, f"out={root / piece.table} console=json"])


def list_tests(run: Run, root: Path, tiny: bool) -> Iterator[str]:
    """Yield the tests with distractors that a run still lacks."""
    frames, data = (4, root) if tiny else (CLUTTERED, Path("outputs/data"))
    for count in DISTRACTORS:
        out = root / "clutter" / f"{run.model}_{count}_{run.seed}"
        if (HOME / out / "metrics.json").is_file():
            continue
        scenes = (
            f"data=scenes data.root={data / f'carton_clutter_{count}'} data.object=carton "
            f"data.generate.frames={frames} data.generate.frames_per_scene=2 "
            f"data.generate.seed={1000 + count} data.generate.distractors=[{count},{count}] "
            "data.generate.occluded_fraction=0 data.split={train:1.0,val:train,test:train}"
        )
        checkpoint = str(run.folder / "checkpoints" / "best.ckpt")
        checkpoint = checkpoint.replace("=", r"\=").replace(",", r"\,")
        seed = f"seed={run.seed}"  # by which rows of runs.csv are told apart
        yield f"evaluate.py checkpoint={checkpoint} {scenes} {seed} out={out} console=json"


def estimate_minutes(piece: Piece, model: str) -> float:
    """Return the processor time that a piece takes with a method, without rendering [min]."""
    cost = COSTS[model]
    if piece.table == "clutter":
        each = len(DISTRACTORS) * (START + CLUTTERED * (cost.image + METRICS))
    else:
        learning = TIME if piece.table == "learning_time" else STEPS * cost.step
        each = START + learning + (TESTED + VALIDATED) * (cost.image + METRICS)
    return len(piece.seeds) * len(piece.sizes) * each / 60


def list_choices(metrics: Mapping[str, Any]) -> dict[str, str]:
    """Return what was chosen on the command line of a run, by key."""
    words = [word.lstrip("+") for word in metrics["overrides"]]
    return dict(word.split("=", 1) for word in words if "=" in word)


def find_runs(root: Path) -> Iterator[Run]:
    """Yield each finished run."""
    for file in sorted((HOME / root).glob("*/metrics.json")):
        metrics = json.loads(file.read_text())
        typed = list_choices(metrics)
        if "data.limit_train" in typed:
            folder, size = file.parent.relative_to(HOME), int(typed["data.limit_train"])
            yield Run(folder, metrics["model"], size, int(metrics["seed"]))


def read_tests(root: Path) -> dict[str, list[Tested]]:
    """Return the tests of each table."""
    tests: dict[str, list[Tested]] = {
        table: [
            Tested(run.model, run.size, run.seed, read_errors(HOME / run.folder / FILE))
            for run in find_runs(root / table)
        ]
        for table in SCHEDULES
    }
    tests["clutter"] = []
    for file in sorted((HOME / root / "clutter").glob(f"*/{FILE}")):
        model, count, seed = file.parent.name.rsplit("_", 2)
        tests["clutter"].append(Tested(model, int(count), int(seed), read_errors(file)))
    return tests


def measure_auc(rows: Sequence[ImageError]) -> float:
    """Return the ADD AUC of some images."""
    return auc(torch.tensor([row.add_mm for row in rows], dtype=torch.float64) / 1000)


def measure_recall(rows: Sequence[ImageError]) -> float:
    """Return the share of images with an ADD below a tenth of the diameter [%]."""
    errors, diameters = (
        torch.tensor([getattr(row, name) for row in rows]) for name in ("add_mm", "diameter_mm")
    )
    return recall(errors, 0.1 * diameters)


def measure_on_object(rows: Sequence[ImageError]) -> float:
    """Return the share of the last particles that lie on the object [%]."""
    return 100 * float(np.mean([row.particles_on_object for row in rows]))


def bootstrap(
    runs: Sequence[Sequence[ImageError]], measure: Callable[[Sequence[ImageError]], float]
) -> str:
    """Return the mean of a figure over seeds, and its 95 % interval over scenes and seeds, both
    drawn with replacement; in brackets the number of seeds, where there are several.
    """
    scenes = sorted({row.scene_id for rows in runs for row in rows})
    groups = [[[row for row in rows if row.scene_id == scene] for scene in scenes] for rows in runs]
    generator = np.random.default_rng(0)
    values = []
    for drawn in generator.integers(len(scenes), size=(RESAMPLED, len(scenes))):
        seeds = generator.integers(len(runs), size=len(runs))
        parts = [[row for i in drawn for row in groups[seed][i]] for seed in seeds]
        values.append(np.mean([measure(part) for part in parts if part]))
    low, high = np.percentile(values, [2.5, 97.5])
    found = np.mean([measure(rows) for rows in runs])
    return f"{found:.1f} [{low:.0f}, {high:.0f}]" + (f" ({len(runs)})" if len(runs) > 1 else "")


def tabulate(
    tests: Sequence[Tested],
    columns: Sequence[int],
    measure: Callable[[Sequence[ImageError]], float],
    models: Sequence[str] = POSED,
) -> Table:
    """Return a row a method and a column a setting; a dash where there is no test."""
    found: dict[tuple[str, int], list[list[ImageError]]] = {}
    for test in tests:
        found.setdefault((test.model, test.at), []).append(test.rows)
    cells = {key: bootstrap(runs, measure) for key, runs in found.items()}
    rows = [format_row([f"`{m}`", *[cells.get((m, at), "–") for at in columns]]) for m in models]
    return ["", *[f"{at:,}" for at in columns]], rows


def tabulate_visibility(tests: Sequence[Tested], at: int) -> Table:
    """Return a row a method, of the tests at one setting, and a column a range of visibility."""
    rows, counts = [], [0] * len(VISIBLE)
    for model in POSED:
        runs = [test.rows for test in tests if (test.model, test.at) == (model, at)]
        cells = []
        for column, (low, high) in enumerate(VISIBLE):
            parts = [[r for r in run if low <= r.visibility < high] for run in runs]
            parts = [part for part in parts if part]
            counts[column] = max([counts[column], *map(len, parts)])
            cells.append(bootstrap(parts, measure_auc) if parts else "–")
        rows.append(format_row([f"`{model}`", *cells]))
    head = [
        f"{low:g} to {min(high, 1):g} ({count} images)"
        for (low, high), count in zip(VISIBLE, counts, strict=True)
    ]
    return ["", *head], rows


def write_tables(root: Path, page: Path) -> None:
    """Write the tables of the page."""
    tests = read_tests(root)
    steps, time, clutter = (tests[name] for name in ("learning_curve", "learning_time", "clutter"))
    tables = {
        "auc": tabulate(steps, SIZES, measure_auc),
        "recall": tabulate(steps, SIZES, measure_recall),
        "on_object": tabulate(steps, SIZES, measure_on_object, IN_IMAGE),
        "auc_in_time": tabulate(time, SIZES, measure_auc),
        "recall_in_time": tabulate(time, SIZES, measure_recall),
        "visibility": tabulate_visibility(steps, MOST),
        "visibility_few": tabulate_visibility(steps, min(SIZES)),
        "distractors": tabulate(clutter, DISTRACTORS, measure_auc),
        "visibility_cluttered": tabulate_visibility(clutter, max(DISTRACTORS)),
    }
    text = page.read_text()
    for title, (head, rows) in tables.items():
        if any("[" in row for row in rows):
            text = put_table(text, title, head, keep_cells(rows, read_rows(text, title)))
    page.write_text(text)


def keep_cells(rows: Sequence[str], old: Sequence[str]) -> list[str]:
    """Return a table's rows with the old cells of the same method where the new ones are dashes."""
    known = {cells[0]: cells for cells in map(split_row, old)}
    kept = []
    for row in map(split_row, rows):
        before = known.get(row[0], row)
        kept.append(format_row([b if a == "–" else a for a, b in zip(row, before, strict=True)]))
    return kept


def write_results(tiny: bool) -> int:
    """Write the runs' rows, and the tables of the page; return the worst status."""
    root, page, rows = ROOT, PAGE, PAGE.with_name("runs.csv")
    if tiny:
        root = TINY_ROOT
        page, rows = HOME / root / PAGE.name, HOME / root / "runs.csv"
        page.write_text(PAGE.read_text())
    write_tables(root, page)
    return run_command(["bench/collect_runs.py", str(root), f"--out={rows}"])


def main() -> int:
    """Run the plan; the status is that of the worst command."""
    parser = make_parser(__doc__)
    parser.add_argument("more", nargs="*")
    names = [piece.name for piece in PLAN]
    parser.add_argument("--only", action="append", choices=[*names, "tables"])
    parser.add_argument("--model", action="append", choices=MODELS)
    parser.add_argument("--list", action="store_true", help="print the commands, run nothing")
    parser.add_argument("--tiny", action="store_true", help="at toy size: does every piece run?")
    options = parser.parse_args()
    models, worst, total = options.model or MODELS, 0, 0.0
    for piece in PLAN:
        if options.only and piece.name not in options.only:
            continue
        minutes = sum(estimate_minutes(piece, model) for model in models)
        total += minutes
        print(
            f"# {piece.name}: {minutes:.0f} min of processor time, {total:.0f} in all", flush=True
        )
        for line in list_lines(piece, models, options.tiny):
            worst = max(worst, run_command([*line.split(), *options.more], options.list))
        if not options.list:
            worst = max(worst, write_results(options.tiny))
    if not options.list and options.only == ["tables"]:
        worst = write_results(options.tiny)
    return worst


if __name__ == "__main__":
    sys.exit(main())
