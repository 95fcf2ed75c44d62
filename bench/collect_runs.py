"""Write down every run of outputs/methods as a row of docs/results/runs.csv, and its tables anew.

    python bench/collect_runs.py [FOLDER] [--out docs/results/runs.csv]

FOLDER (default: outputs/methods, where bench/methods.py puts its runs) has a folder a table,
searched for metrics.json. A run replaces the row of the same table, method, settings and seed; all
other rows stay, so that a part of a table can be made by itself. `bench/tables.py` then fills the
tables of the documents.
"""

import csv
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from programs import HOME, make_parser, run_command

from posefilter.cli.ablations import ABLATIONS
from posefilter.cli.folders import own_metrics
from posefilter.cli.renamed import rename
from posefilter.metrics.registry import find_metric, read_number

KEYS = (
    "particles_on_object", "diagnostics/on_object/first", "iou", "add/auc", "add/recall_01d",
    "add_s/auc", "diagnostics/distinct/last", "diagnostics/pairwise_cosine",
    "diagnostics/offset_cosine", "diagnostics/offset_r2", "diagnostics/off_frame/last",
    "diagnostics/near_edge/last", "diagnostics/near_corner/last",
    "diagnostics/first_axis_share/first", "diagnostics/first_axis_share/last", "diagnostics/auroc",
    "credibility/log_density",
)  # fmt: skip
NAMED = ("model", "variant", "experiment", "sweep", "seed", "checkpoint")  # have columns, or none
# these change no result
SILENT = ("logger", "callbacks", "hydra", "out", "resume", "console", "threads")
SILENT_KEYS = ("data.root", "data.meshes", "data.workers", "data.generate.workers")
BY_VISIBILITY = {"shipped"}  # tables that have rows of ranges of visibility
ORDER = {ablation.name: number for number, ablation in enumerate(ABLATIONS)}
WHOLE = ("seed", "steps", "tested step")  # two seeds that differ late are two runs
ROW = ("table", "method", "variant", "changed", "seed")  # what tells a row from others
RENAMED = {  # columns, by their names before
    "along a line %": "first-axis share %",
    "along a line at start %": "first-axis share at start %",
}
Run = dict[str, Any]


def read_column(key: str) -> Callable[[Run], float | None]:
    """Return what reads a metric of a run, in the unit of its column."""

    def read(run: Run) -> float | None:
        value = read_number(run, key)
        return None if value is None else find_metric(key).convert(value)

    return read


COLUMNS: dict[str, Callable[[Run], float | None]] = {
    **{find_metric(key).column: read_column(key) for key in KEYS},
    "median mm": read_column("add/median_mm"),
    "outscored %": read_column("belief/truth_outscored_by_wrong"),
    "CPU min": lambda run: run["training"]["steps"] * run["training"]["cpu_seconds_per_step"] / 60,
    "s / image": read_column("seconds_per_image"),
    "seed": lambda run: run["seed"],
    "steps": read_column("training/steps"),
    "tested step": read_column("training/tested_step"),
}


def read_runs(folder: Path) -> list[Run]:
    """Return the metrics of every run below a folder, each with its overrides under `choices`; of a
    run that was evaluated in its own folder those of its own test.
    """
    runs = []
    for path in sorted(folder.rglob("metrics.json")):
        if (path.parents[1] / "checkpoints").is_dir():
            continue  # an evaluation that a run which went on has moved into its folder
        run: Run = own_metrics(path.parent)
        if not run:
            continue  # of a training that has not ended
        if "signs" in run:  # the name of before
            run["diagnostics"] = run.pop("signs")
        typed = [
            name_today(text.lstrip("+~")) for text in run.get("overrides") or [] if "=" in text
        ]
        run["choices"] = dict(text.split("=", 1) for text in typed)
        # a test on other data is of the row and the seed that its checkpoint is of
        of = re.search(r"\bablation=(\w+),.*\bseed=(\d+)", run.get("checkpoint") or "")
        if of and "data" in run["choices"]:
            run["choices"]["ablation"], run["seed"] = of[1], int(of[2])
        runs.append(run)
    return runs


def name_today(override: str) -> str:
    """Return an override by today's names, so that a run keeps the row of those before it."""
    now = rename(override, "train")
    return override if now is None or " " in now else now


def read_rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a table of runs by today's names of columns and settings."""
    with path.open() as file:
        rows = [
            {RENAMED.get(name, name): cell for name, cell in row.items()}
            for row in csv.DictReader(file)
        ]
    for row in rows:
        row["changed"] = " ".join(map(name_today, row["changed"].split()))
    return rows


def describe(run: Run) -> tuple[str, str, str]:
    """Return method, variant, and what else was chosen, as it is typed, without the seed."""
    choices = run["choices"]
    rest = [
        f"{key}={value}"
        for key, value in choices.items()
        if key not in (*NAMED, *SILENT_KEYS) and key.split(".")[0] not in SILENT
    ]
    method, variant = (run.get(key) or choices.get(key) or "?" for key in ("model", "variant"))
    return method, variant, " ".join(sorted(rest))


def order(row: dict[str, str]) -> tuple[Any, ...]:
    """Return what rows are sorted by: ablations as their table has them, numbers by their size."""
    rest = row["changed"]
    ablation = re.search(r"\bablation=(\w+)", rest)
    numbers = [
        (0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", rest)
    ]
    step = ORDER.get(ablation[1], len(ORDER)) if ablation else -1
    return row["table"], row["method"], row["variant"], step, numbers, float(row["seed"] or 0)


def read_figure(run: Run, read: Callable[[Run], float | None]) -> float | None:
    """Return a figure of a run; None where it has none, or no number."""
    try:
        value = read(run)
    except (KeyError, IndexError, TypeError):
        return None
    return float(value) if isinstance(value, int | float) and value == value else None


def split_by_visibility(run: Run) -> list[Run]:
    """Return a run and, as runs of their own, its ranges of visibility."""
    ranges = (run.get("by_visibility") or {}).items()
    of_all = ("model", "variant", "seed", "device", "versions")
    kept = {key: run[key] for key in of_all if key in run}
    parts = [
        kept | errors | {"choices": run["choices"] | {"visibility": name}}
        for name, errors in ranges
    ]
    return [run, *parts]


def write_figure(name: str, value: float | None) -> str:
    """Return a column's figure: to six digits, a seed or a number of steps with all of them; empty
    where there is none.
    """
    if value is None:
        return ""
    return f"{value:.0f}" if name in WHOLE else f"{value:.6g}"


def make_rows(table: str, runs: Iterable[Run]) -> list[dict[str, str]]:
    """Return a table's runs as rows."""
    rows = []
    if table in BY_VISIBILITY:
        runs = [part for run in runs for part in split_by_visibility(run)]
    for run in runs:
        figures = {name: read_figure(run, read) for name, read in COLUMNS.items()}
        rows.append(
            dict(
                zip(("table", "method", "variant", "changed"), (table, *describe(run)), strict=True)
            )
            | {name: write_figure(name, value) for name, value in figures.items()}
            | {"device": run.get("device") or ""}
            | {"torch": (run.get("versions") or {}).get("torch") or ""}
        )
    return rows


def main() -> int:
    """Read the runs, replace their rows, and fill the tables of the documents."""
    parser = make_parser(__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=Path("outputs/methods"))
    parser.add_argument("--out", type=Path, default=HOME / "docs" / "results" / "runs.csv")
    options = parser.parse_args()
    tables = {path.name: read_runs(path) for path in sorted(options.folder.glob("*/"))}
    tables = {name: runs for name, runs in tables.items() if runs}
    if not tables:
        print(f"{options.folder}: holds no run", file=sys.stderr)
        return 1
    rows = {}
    if options.out.is_file():
        rows = {tuple(row[name] for name in ROW): row for row in read_rows(options.out)}
    for name, runs in tables.items():
        print(f"{name}: {len(runs)} runs")
        rows |= {tuple(row[key] for key in ROW): row for row in make_rows(name, runs)}
    with options.out.open("w", newline="") as file:
        header = ["table", "method", "variant", "changed", *COLUMNS, "device", "torch"]
        writer = csv.DictWriter(file, header, lineterminator="\n")
        writer.writeheader()
        writer.writerows(sorted(rows.values(), key=order))
    return run_command(["bench/tables.py"])


if __name__ == "__main__":
    sys.exit(main())
