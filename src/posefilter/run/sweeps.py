"""What a sweep found, in one place: summary.csv, summary.md and summary.png, brought up to date as each job ends."""

import csv
import json
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn
from hydra.experimental.callback import Callback
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from omegaconf import DictConfig

from posefilter.report.sweeps import number
from posefilter.run.voice import PLAIN, ended, typed

COLUMNS = {
    "add_auc": ("add", "auc"),
    "add_recall_01d": ("add", "recall_01d"),
    "add_median_mm": ("add", "median_mm"),
    "add_s_auc": ("add_s", "auc"),
    "iou": ("iou",),
    "particles_on_object": ("particles_on_object",),
    "seconds_per_image": ("seconds_per_image",),
}
_TITLES = {"add_auc": "ADD AUC", "iou": "box IoU", "particles_on_object": "particles on the object (share)"}
Row = dict[str, Any]


class SweepSummary(Callback):
    """Hydra's callback: sums up a sweep's folder."""

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Bring the summary up to date: a sweep that is cut short has one too."""
        if "id" in config.hydra.job and str(config.hydra.mode).endswith("MULTIRUN"):
            summarise(Path(config.hydra.sweep.dir))

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Say where the summary is."""
        folder = Path(config.hydra.sweep.dir)
        if summarise(folder):
            files = {"summary": folder / "summary.csv", "picture": folder / "summary.png"}
            console = str(config.get("console", PLAIN))
            if console != PLAIN:
                print((folder / "summary.md").read_text())
            ended(console, "swept", files, [typed("report", sweep=folder)])


def summarise(folder: Path) -> list[Row]:
    """Write the three files of a sweep's folder; returns its rows, none where no job has ended yet."""
    rows, axes = read_rows(folder)
    if not rows:
        return []
    names = [*axes, *(name for name in COLUMNS if any(row[name] is not None for row in rows)), "folder"]
    with (folder / "summary.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    lines = ["| " + " | ".join(names[:-1]) + " |", "|---" * (len(names) - 1) + "|"]
    lines += ["| " + " | ".join(_cell(row[name]) for name in names[:-1]) + " |" for row in rows]
    (folder / "summary.md").write_text("\n".join(lines) + "\n")
    draw(rows, axes).savefig(folder / "summary.png", dpi=120)
    return rows


def read_rows(folder: Path) -> tuple[list[Row], list[str]]:
    """Return a row a job that has ended, and the settings in which the jobs differ."""
    rows, said = [], []
    for path in sorted(folder.rglob("metrics.json")):
        metrics = json.loads(path.read_text())
        pairs = dict(o.lstrip("+~").split("=", 1) for o in metrics["overrides"] if "=" in o)
        row: Row = {"folder": str(path.parent.relative_to(folder))}
        for name, keys in COLUMNS.items():
            value: Any = metrics
            for key in keys:
                value = value.get(key) if isinstance(value, dict) else None
            row[name] = value
        rows.append(row)
        said.append(pairs)
    typed = dict.fromkeys(key for pairs in said for key in pairs)
    axes = [key for key in typed if len({pairs.get(key) for pairs in said}) > 1 and key not in ("out", "resume")]
    for row, pairs in zip(rows, said, strict=True):
        row.update({key: number(pairs.get(key, "")) for key in axes})
    rows.sort(key=lambda row: [(isinstance(row[key], str), row[key]) for key in axes])
    return rows, axes


def draw(rows: list[Row], axes: list[str]) -> Figure:
    """Draw quality and cost over each swept setting: a dot a job, a line through the means."""
    shown = [
        name
        for name in ("add_auc", "iou", "particles_on_object", "seconds_per_image")
        if any(r[name] is not None for r in rows)
    ]
    axes = [key for key in axes if key != "seed"] or axes or ["folder"]
    figure = Figure(figsize=(4.2 * len(shown), 3.4 * len(axes)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(axes), len(shown), squeeze=False)
    for line, key in zip(panels, axes, strict=True):
        values = list(dict.fromkeys(row[key] for row in rows))
        numeric = all(isinstance(value, int | float) for value in values)
        places = dict(zip(values, values if numeric else range(len(values)), strict=True))
        for panel, name in zip(line, shown, strict=True):
            dots = [(places[row[key]], row[name]) for row in rows if row[name] is not None]
            means = {x: [y for at, y in dots if at == x] for x in sorted({x for x, _ in dots})}
            panel.plot(list(means), [sum(ys) / len(ys) for ys in means.values()], "-", color="tab:blue", label="mean")
            panel.plot(*zip(*dots, strict=True), "o", color="tab:blue", alpha=0.6, label="run")
            panel.set(xlabel=key, ylabel=_TITLES.get(name, name.replace("_", " ")))
            panel.grid(alpha=0.3)
            if numeric and min(values) > 0 and max(values) / min(values) >= 10:
                panel.set_xscale("log")
            if not numeric:
                panel.set_xticks(list(places.values()), [str(value)[:24] for value in values], rotation=45, ha="right")
    panels[0, 0].legend()
    return figure


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
