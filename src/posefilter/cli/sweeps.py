"""What a sweep found, in one place: summary.csv, summary.md and summary.png, brought up to date as
each job ends.
"""

import csv
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from posefilter.cli.console import JSON, ended, typed

Row = dict[str, Any]


class SweepSummary(Callback):
    """Hydra's callback: sums up a sweep's folder."""

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Bring the summary up to date: a sweep that is cut short has one too."""
        if "id" in config.hydra.job and str(config.hydra.mode).endswith("MULTIRUN"):
            summarize(Path(config.hydra.sweep.dir))

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Say where the summary is."""
        folder = Path(config.hydra.sweep.dir)
        if summarize(folder):
            files = {"summary": folder / "summary.csv", "picture": folder / "summary.png"}
            console = str(config.get("console", JSON))
            if console != JSON:
                print((folder / "summary.md").read_text())
            ended(console, "swept", files, [typed("report", sweep=folder)])


def summarize(folder: Path) -> list[Row]:
    """Write the three files of a sweep's folder; returns its rows, none where no job has ended yet."""
    if not any(folder.glob("*/**/metrics.json")):
        return []
    from posefilter.report.summary import draw_summary  # Hydra makes this callback in every run
    from posefilter.report.sweeps import COLUMNS

    rows, axes = read_rows(folder)
    names = [
        *axes,
        *(name for name in COLUMNS if any(row[name] is not None for row in rows)),
        "folder",
    ]
    with (folder / "summary.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    lines = ["| " + " | ".join(names[:-1]) + " |", "|---" * (len(names) - 1) + "|"]
    lines += ["| " + " | ".join(_cell(row[name]) for name in names[:-1]) + " |" for row in rows]
    (folder / "summary.md").write_text("\n".join(lines) + "\n")
    draw_summary(rows, axes).savefig(folder / "summary.png", dpi=120)
    return rows


def read_rows(folder: Path) -> tuple[list[Row], list[str]]:
    """Return a row a job that has ended, and the settings in which the jobs differ."""
    from posefilter.report.sweeps import COLUMNS, read_sweep

    sweep = read_sweep(folder)
    rows: list[Row] = []
    for job in sweep.jobs:
        figures = {name: job.numbers.get(figure) for name, figure in COLUMNS.items()}
        rows.append({"folder": job.folder, **figures, **job.place})
    return rows, sweep.axes


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
