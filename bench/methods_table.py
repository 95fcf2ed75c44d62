"""Write the result tables of docs/methods.md from the metrics.json files of runs.

    python bench/methods_table.py [FOLDER] [--into docs/methods.md]

FOLDER (default: outputs/methods, where bench/methods.py puts its runs) has a folder a table,
searched for metrics.json. Runs that differ only in their seed become one row: mean, and half the
range between the best and the worst seed. Tables replace what stands between `<!-- table: NAME -->`
and `<!-- end -->`, NAME being the table's folder; one without runs stays. `<!-- table: NAME (on
object %, AUROC) -->` has these figures only. What is the same in every row is left out. `relative
time` is an image's, in units of the fastest row's: for tables whose runs were made one after
another. `loss jumps` is the largest training loss over the median, of those logged in a training's
second half. Every run by itself, with all its figures, goes to a CSV file beside the page.
"""

import argparse
import csv
import io
import json
import re
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any

from posefilter.cli.ablations import find_ablation
from posefilter.metrics.registry import find_metric, read_number
from posefilter.report.events import read_events

KEYS = (
    "particles_on_object", "signs/on_object/first", "iou", "add/auc", "add/recall_01d", "add_s/auc", "signs/distinct/last",
    "signs/pairwise_cosine", "signs/heading", "signs/offset_r2", "signs/off_frame/last", "signs/near_edge/last",
    "signs/near_corner/last", "signs/auroc",
)  # fmt: skip


def column(key: str) -> Callable[[dict[str, Any]], float | None]:
    """Return what reads a number out of a run, in the unit of its column."""
    return lambda run: (
        None if (value := read_number(run, key)) is None else find_metric(key).convert(value)
    )


COLUMNS: dict[str, Callable[[dict[str, Any]], Any]] = {
    **{find_metric(key).column: column(key) for key in KEYS},
    "CPU min": lambda m: m["training"]["steps"] * m["training"]["cpu_seconds_per_step"] / 60,
}
RELATIVE = "relative time"
# only where a mark asks for it, since it takes a while
ASKED = {"loss jumps": lambda m: loss_jumps(Path(m["path"]).parent)}
NAMES = ("model", "variant", "experiment", "sweep", "seed", "checkpoint")
# these change no result
SILENT = (
    "logger",
    "callbacks",
    "hydra",
    "out",
    "resume",
    "console",
    "threads",
    "data.root",
    "data.meshes",
    "data.workers",
)
# of ablations, by what their names begin with
ORDER = ("paper", "s", "box_s", "c", "box_c", "pose_c", "working", "m", "box_m", "pose_m")


def read_runs(folders: Iterable[Path]) -> list[dict[str, Any]]:
    """Return the metrics of every run found, each with its overrides as a dictionary under
    `choices`.
    """
    runs = []
    for folder in folders:
        for path in sorted(folder.rglob("metrics.json")):
            metrics = json.loads(path.read_text())
            pairs = [
                o.lstrip("+~").split("=", 1) for o in metrics.get("overrides") or [] if "=" in o
            ]
            metrics["choices"] = dict(pairs)
            metrics["path"] = str(path)
            runs.append(metrics)
    return runs


def key_of(run: dict[str, Any]) -> tuple[str, str, str]:
    """Return method, variant, and whatever else was chosen, but for the seed."""
    choices = run["choices"]
    rest = [
        f"{k}={v}"
        for k, v in choices.items()
        if k not in NAMES and k.split(".")[0] not in SILENT and k not in SILENT
    ]
    name, variant = (run.get(key) or choices.get(key) or "?" for key in ("model", "variant"))
    return name, variant, " ".join(sorted(rest))


def place(key: tuple[str, str, str]) -> tuple[Any, ...]:
    """Return what rows are sorted by: methods and numbers as one counts them, ablations in
    order.
    """
    model, variant, rest = key
    ablation = re.search(rf"\bablation=({'|'.join(ORDER)})(\d*)(?:_|\b)", rest)
    climbed = (ORDER.index(ablation[1]), int(ablation[2] or 0)) if ablation else (-1, 0)
    return (
        model,
        climbed,
        variant,
        [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", rest)],
    )


def told(rest: str) -> str:
    """Return what was chosen, as it is typed; an ablation also in its description's words."""
    if not rest:
        return ""
    named = re.search(r"\bablation=(\w+)", rest)
    ablation = find_ablation(named[1]) if named else None
    return f"`{rest}`" + (f" {ablation.description.rstrip('.')}" if ablation else "")


def figure(run: dict[str, Any], read: Callable[[dict[str, Any]], Any]) -> float | None:
    """Return a figure of a run; nothing where it has none, or no number."""
    try:
        value = read(run)
    except (KeyError, IndexError, TypeError):
        return None
    return float(value) if isinstance(value, int | float) and value == value else None


def cell(runs: list[dict[str, Any]], read: Callable[[dict[str, Any]], Any]) -> str:
    """Return `mean ± half range` of a figure over seeds; a dash where no run has it."""
    values = [value for run in runs if (value := figure(run, read)) is not None]
    if not values:
        return "–"
    mean, half = sum(values) / len(values), (max(values) - min(values)) / 2
    digits = 1 if abs(mean) >= 5 else 2
    return f"{mean:.{digits}f}" + (f" ± {half:.{digits}f}" if len(values) > 1 else "")


def table(runs: list[dict[str, Any]], figures: Sequence[str] = tuple(COLUMNS)) -> str:
    """Return a Markdown table, one row a kind of run.  Raises KeyError for an unknown figure."""
    rows = defaultdict(list)
    for run in runs:
        rows[key_of(run)].append(run)
    known = (
        COLUMNS | ASKED | ({RELATIVE: relative_time(rows.values())} if RELATIVE in figures else {})
    )
    shown = {
        name: known[name]
        for name in figures
        if any(cell([run], known[name]) != "–" for run in runs)
    }
    typed = [set(rest.split()) for _, _, rest in rows]
    common = set.intersection(*typed) if len(rows) > 1 else set()  # is said once, above the table
    columns: dict[str, list[str]] = defaultdict(list)
    for model, variant, rest in sorted(rows, key=place):
        same = rows[model, variant, rest]
        columns["method"].append(model)
        columns["variant"].append(variant)
        columns["changed"].append(
            told(" ".join(part for part in rest.split() if part not in common))
        )
        columns["seeds"].append(
            str(len({str(run.get("seed", run["choices"].get("seed"))) for run in same}))
        )
        for name, read in shown.items():
            columns[name].append(cell(same, read))
    if len(set(columns["variant"])) == 1:
        del columns["variant"]
    if not any(columns["changed"]):
        del columns["changed"]
    lines = [list(columns), ["---"] * len(columns), *zip(*columns.values(), strict=True)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def relative_time(rows: Iterable[list[dict[str, Any]]]) -> Callable[[dict[str, Any]], float]:
    """Return the figure of a run that is its time for an image, in units of the fastest row's."""
    times = [
        [run["seconds_per_image"] for run in row if "seconds_per_image" in run] for row in rows
    ]
    least = min((sum(row) / len(row) for row in times if row), default=1.0)
    return lambda run: run["seconds_per_image"] / least


@cache
def loss_jumps(run: Path) -> float | None:
    """Return the largest training loss over the median, of those logged in the second half; None
    where none was logged.
    """
    curve = read_events(run)[0].get("train/total")
    late = (
        [
            value
            for step, value in zip(curve.steps, curve.values, strict=True)
            if 2 * step >= curve.steps[-1]
        ]
        if curve
        else []
    )
    return max(late) / median(late) if late and median(late) > 0 else None


def sheet(found: dict[str, list[dict[str, Any]]]) -> str:
    """Return all tables' runs as CSV: a row a run, all figures to six digits, empty where a run has
    none.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    columns = {
        **COLUMNS,
        "s / image": column("seconds_per_image"),
        "seed": lambda m: m["seed"],
        "steps": column("training/steps"),
        "tested step": column("training/tested_step"),
    }
    writer.writerow(["table", "method", "variant", "changed", *columns, "device", "torch"])
    for name, runs in found.items():
        for run in sorted(
            runs, key=lambda run: (place(key_of(run)), figure(run, columns["seed"]) or 0)
        ):
            figures = [figure(run, read) for read in columns.values()]
            texts = ["" if value is None else f"{value:.6g}" for value in figures]
            writer.writerow(
                [
                    name,
                    *key_of(run),
                    *texts,
                    run.get("device"),
                    (run.get("versions") or {}).get("torch"),
                ]
            )
    return out.getvalue()


def insert(page: str, name: str, runs: list[dict[str, Any]]) -> str:
    """Return the page with the table called `name` made anew, of the figures that its mark asks
    for.
    """
    return fill(page, name, lambda figures: table(runs, figures or tuple(COLUMNS)))


def fill(page: str, name: str, make: Callable[[Sequence[str]], str]) -> str:
    """Return the page with another table called `name`: made from the figures that its mark asks
    for, if any.
    """

    def filled(found: re.Match[str]) -> str:
        asked = (
            [figure.strip() for figure in found["figures"].split(",")] if found["figures"] else []
        )
        return f"{found['mark']}\n{make(asked)}\n<!-- end -->"

    return re.sub(mark(name) + r"\n.*?<!-- end -->", filled, page, flags=re.DOTALL)


def mark(name: str) -> str:
    """Return the pattern of what stands before a table."""
    return rf"(?P<mark><!-- table: {re.escape(name)}(?: \((?P<figures>[^)]*)\))? -->)"


def main() -> int:
    """Read the runs, write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", nargs="?", type=Path, default=Path("outputs/methods"))
    parser.add_argument("--into", type=Path, default=Path("docs/methods.md"))
    options = parser.parse_args()
    page = options.into.read_text()
    found = {
        folder.name: read_runs([folder])
        for folder in sorted(options.folder.glob("*"))
        if folder.is_dir()
    }
    found = {name: runs for name, runs in found.items() if runs}
    for name, runs in found.items():
        missing = "" if re.search(mark(name), page) else f" (no such table in {options.into})"
        print(f"{name}: {len(runs)} runs{missing}")
        page = insert(page, name, runs)
    options.into.write_text(page)
    options.into.with_suffix(".csv").write_text(sheet(found))
    return 0 if found else 1


if __name__ == "__main__":
    sys.exit(main())
