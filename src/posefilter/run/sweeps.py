"""What a sweep found, in one place: summary.csv, summary.md and summary.png, brought up to date as each job ends."""

import csv
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn
from hydra.experimental.callback import Callback
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from omegaconf import DictConfig

from posefilter.report.sweeps import COLUMNS, read_sweep
from posefilter.run.voice import PLAIN, ended, typed

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
    if not any(folder.glob("*/**/metrics.json")):
        return []
    rows, axes = read_rows(folder)
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
    sweep = read_sweep(folder)
    rows: list[Row] = []
    for job in sweep.jobs:
        figures = {name: job.numbers.get(figure) for name, figure in COLUMNS.items()}
        rows.append({"folder": job.folder, **figures, **job.place})
    return rows, sweep.axes


def draw(rows: list[Row], axes: list[str]) -> Figure:
    """Draw quality and cost over each swept setting, a dot a job: means as a line over numbers, as bars at words."""
    shown = [
        name
        for name in ("add_auc", "iou", "particles_on_object", "seconds_per_image")
        if any(r[name] is not None for r in rows)
    ]
    axes = [key for key in axes if key != "seed"] or axes or ["folder"]
    values = {key: list(dict.fromkeys(row[key] for row in rows)) for key in axes}
    words = {key for key in axes if any(isinstance(value, str) for value in values[key])}
    heights = [max(3.4, 1.2 + 0.22 * len(values[key])) if key in words else 3.4 for key in axes]
    figure = Figure(figsize=(4.2 * len(shown), sum(heights)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(axes), len(shown), squeeze=False, height_ratios=heights)
    for line, key in zip(panels, axes, strict=True):
        for panel, name in zip(line, shown, strict=True):
            dots = [(row[key], row[name]) for row in rows if row[name] is not None]
            there = {x for x, _ in dots}
            order = [at for at in values[key] if at in there] if key in words else sorted(there)
            means = {at: [y for x, y in dots if x == at] for at in order}
            middles = [sum(ys) / len(ys) for ys in means.values()]
            title = _TITLES.get(name, name.replace("_", " "))
            panel.grid(alpha=0.3)
            if key in words:  # from the top, as they were typed
                places = {value: place for place, value in enumerate(values[key])}
                panel.barh([places[at] for at in means], middles, height=0.7, color="tab:blue", alpha=0.25, label="mean")
                panel.plot([y for _, y in dots], [places[x] for x, _ in dots], "o", color="tab:blue", alpha=0.6, label="run")
                panel.set_yticks(list(places.values()), [str(value)[:32] for value in places])
                first = panel is line[0]  # has the words for its line
                panel.tick_params(labelleft=first)
                panel.set(xlabel=title, ylabel=key if first else "", ylim=(len(places) - 0.5, -0.5))
                continue
            panel.plot(list(means), middles, "-", color="tab:blue", label="mean")
            panel.plot(*zip(*dots, strict=True), "o", color="tab:blue", alpha=0.6, label="run")
            panel.set(xlabel=key, ylabel=title)
            if min(values[key]) > 0 and max(values[key]) / min(values[key]) >= 10:
                panel.set_xscale("log")
    panels[0, 0].legend()
    return figure


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
