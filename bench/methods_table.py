"""Write the result tables of docs/methods.md from the metrics.json files of runs.

    python bench/methods_table.py [FOLDER ...] [--into docs/methods.md]

Folders are searched for metrics.json (default: outputs/runs and outputs/sweeps). Runs that differ only in their seed become
one row: mean, and half the range between the best and the worst seed. Tables replace what stands between
`<!-- table: NAME -->` and `<!-- end -->`, NAME being a run's experiment or sweep, or `none`; a name without runs stays.
"""

import argparse
import json
import re
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

COLUMNS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "on object %": lambda m: 100 * m["particles_on_object"],
    "box IoU": lambda m: m["iou"],
    "ADD AUC": lambda m: m["add"]["auc"],
    "ADD-S AUC": lambda m: m["add_s"]["auc"],
    "same direction": lambda m: m["signs"]["pairwise_cosine"],
    "offset R2": lambda m: m["signs"]["offset_r2"],
    "off frame %": lambda m: 100 * m["signs"]["off_frame"][-1],
    "at an edge %": lambda m: 100 * m["signs"]["near_edge"][-1],
    "AUROC": lambda m: m["signs"]["auroc"],
    "s / image": lambda m: m["seconds_per_image"],
}
NAMES = ("model", "variant", "experiment", "sweep", "seed")
SILENT = ("logger", "callbacks", "hydra", "trainer", "out", "resume", "data.root")  # change no result


def read_runs(folders: Iterable[Path]) -> list[dict[str, Any]]:
    """Return the metrics of every run found, each with its overrides as a dictionary under `choices`."""
    runs = []
    for folder in folders:
        for path in sorted(folder.rglob("metrics.json")):
            metrics = json.loads(path.read_text())
            pairs = [o.lstrip("+~").split("=", 1) for o in metrics.get("overrides") or [] if "=" in o]
            metrics["choices"] = dict(pairs)
            metrics["path"] = str(path)
            runs.append(metrics)
    return runs


def key_of(run: dict[str, Any]) -> tuple[str, str, str]:
    """Return method, variant, and whatever else was chosen, but for the seed."""
    choices = run["choices"]
    rest = [f"{k}={v}" for k, v in choices.items() if k not in NAMES and k.split(".")[0] not in SILENT and k not in SILENT]
    name, variant = (run.get(key) or choices.get(key) or "?" for key in ("model", "variant"))
    return name, variant, " ".join(rest)


def cell(runs: list[dict[str, Any]], read: Callable[[dict[str, Any]], Any]) -> str:
    """Return `mean ± half range` of a figure over seeds; a dash where no run has it."""
    values = []
    for run in runs:
        try:
            value = read(run)
        except (KeyError, IndexError, TypeError):
            continue
        if isinstance(value, int | float) and value == value:
            values.append(float(value))
    if not values:
        return "–"
    mean, half = sum(values) / len(values), (max(values) - min(values)) / 2
    digits = 1 if abs(mean) >= 5 else 2
    return f"{mean:.{digits}f}" + (f" ± {half:.{digits}f}" if len(values) > 1 else "")


def table(runs: list[dict[str, Any]]) -> str:
    """Return a Markdown table, one row a kind of run."""
    rows = defaultdict(list)
    for run in runs:
        rows[key_of(run)].append(run)
    shown = [name for name, read in COLUMNS.items() if any(cell([run], read) != "–" for run in runs)]
    lines = ["| method | variant | changed | seeds | " + " | ".join(shown) + " |", "|---" * (4 + len(shown)) + "|"]
    for (model, variant, rest), same in sorted(rows.items()):
        seeds = len({str(run.get("seed", run["choices"].get("seed"))) for run in same})
        figures = [cell(same, COLUMNS[name]) for name in shown]
        lines.append(" | ".join([f"| {model}", variant, f"`{rest}`" if rest else "", str(seeds), *figures]) + " |")
    return "\n".join(lines)


def insert(page: str, name: str, content: str) -> str:
    """Return the page with the table called `name` replaced."""
    pattern = re.compile(rf"(<!-- table: {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
    return pattern.sub(lambda m: m[1] + content + "\n" + m[2], page)


def main() -> int:
    """Read the runs, write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path, default=[Path("outputs/runs"), Path("outputs/sweeps")])
    parser.add_argument("--into", type=Path, default=Path("docs/methods.md"))
    options = parser.parse_args()
    groups = defaultdict(list)
    for run in read_runs(options.folders):
        groups[run["choices"].get("sweep") or run["choices"].get("experiment") or "none"].append(run)
    page = options.into.read_text()
    for name, runs in sorted(groups.items()):
        print(
            f"{name}: {len(runs)} runs"
            + ("" if f"<!-- table: {name} -->" in page else f" (no such table in {options.into})")
        )
        page = insert(page, name, table(runs))
    options.into.write_text(page)
    return 0 if groups else 1


if __name__ == "__main__":
    sys.exit(main())
