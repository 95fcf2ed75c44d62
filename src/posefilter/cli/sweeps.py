"""What a sweep found: summary.csv, summary.md and summary.png, brought up to date by each job."""

import csv
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.utils import JobReturn
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from posefilter.cli.console import JSON, ended, typed
from posefilter.cli.folders import FAILED
from posefilter.errors import Carrier, UserError, printable_lines
from posefilter.files import open_whole, open_whole_text, write_whole

if TYPE_CHECKING:
    from posefilter.report.sweeps import Sweep

Row = dict[str, Any]


class SweepSummary(Callback):
    """Hydra's callback: sums up a sweep's folder."""

    def __init__(self) -> None:
        self._before: dict[Path, int] = {}  # notes of failures, and when they were written

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Take note of the failures that an earlier start has left in the folder."""
        self._before = _list_failures(Path(config.hydra.sweep.dir))

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Bring the summary up to date: a sweep that is cut short has one too."""
        if "id" in config.hydra.job and str(config.hydra.mode).endswith("MULTIRUN"):
            summarize(Path(config.hydra.sweep.dir))

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Show the summary and say where it is; the command fails where one of its own jobs has."""
        folder = Path(config.hydra.sweep.dir)
        rows = summarize(folder)
        now = {note.parent for note, _ in _list_failures(folder).items() - self._before.items()}
        failed = [row["folder"] for row in rows if folder / row["folder"] in now]
        if rows:
            names = ("summary.csv", "summary.md", "summary.png")
            files = {name: folder / name for name in names if (folder / name).is_file()}
            console = str(config.get("console", JSON))
            if console != JSON:
                print(printable_lines((folder / "summary.md").read_text(encoding="utf-8")))
            ended(console, "swept", files, [typed("report", sweep=folder)], failed=failed)
        if failed:
            raise Carrier(
                UserError(f"{len(failed)} of {len(rows)} jobs failed: see {folder}/summary.md")
            )


def _list_failures(folder: Path) -> dict[Path, int]:
    """Return the notes of failed jobs below a sweep's folder, and when each was written [ns]."""
    return {note: note.stat().st_mtime_ns for note in folder.rglob(FAILED)}


def summarize(folder: Path) -> list[Row]:
    """Write the three files of a sweep's folder; return its rows, none before a job has ended."""
    if not any(any(folder.glob(f"*/**/{mark}")) for mark in ("metrics.json", FAILED)):
        return []
    # Hydra makes this callback in every run
    from posefilter.report.sweep_charts import draw_summary
    from posefilter.report.sweeps import COLUMNS, read_sweep

    sweep = read_sweep(folder)
    rows = list_rows(sweep)
    found = [name for name in COLUMNS if any(row.get(name) is not None for row in rows)]
    errors = ["error"] if any("error" in row for row in rows) else []
    names = [*sweep.axes, *found, *errors, "folder"]
    with open_whole_text(folder / "summary.csv") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    lines = ["| " + " | ".join(names[:-1]) + " |", "|---" * (len(names) - 1) + "|"]
    lines += ["| " + " | ".join(_cell(row.get(name)) for name in names[:-1]) + " |" for row in rows]
    write_whole(folder / "summary.md", "\n".join(lines) + "\n")
    figure = draw_summary(sweep)
    (folder / "summary.png").unlink(missing_ok=True)
    if figure is not None:
        with open_whole(folder / "summary.png", sync=False) as image:
            figure.savefig(image, format="png", dpi=120)
    return rows


def list_rows(sweep: "Sweep") -> list[Row]:
    """Return a row a job that has ended, those that failed last."""
    from posefilter.report.sweeps import COLUMNS

    rows: list[Row] = []
    for job in sweep.jobs:
        figures = {name: job.numbers.get(figure) for name, figure in COLUMNS.items()}
        rows.append({"folder": job.folder, **figures, **job.place})
    rows += [{"folder": job.folder, "error": job.error, **job.place} for job in sweep.failed]
    return rows


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.4g}"
    return " ".join(str(value).replace("|", r"\|").split())  # which would begin another cell or row
