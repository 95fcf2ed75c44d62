"""Explain a run or a sweep on one HTML page."""

import re
from dataclasses import replace
from pathlib import Path

from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf.errors import OmegaConfBaseException

from posefilter.cli.arguments import TYPED
from posefilter.cli.console import ended, typed
from posefilter.cli.job import Job
from posefilter.cli.plain import to_plain
from posefilter.cli.renamed import update, upgrade
from posefilter.errors import UserError
from posefilter.files import write_whole
from posefilter.paths import check_links
from posefilter.report.comparison_page import make_comparison_page, read_two_runs
from posefilter.report.gather import Run, read_run
from posefilter.report.page import Page
from posefilter.report.run_page import make_run_page
from posefilter.report.settings import Change, compare_settings
from posefilter.report.sweep_page import make_sweep_page
from posefilter.report.sweeps import find_best_job, read_sweep


def report(job: Job) -> None:
    """Write report.html and its charts as PNGs into `out`; else into the run or sweep, or the
    second of two runs.
    """
    keys = ("run", "runs", "sweep_folder")
    given = {TYPED.get(key, key): job.cfg[key] for key in keys if job.cfg[key] is not None}
    if len(given) != 1:
        raise UserError(
            "give one of run=RUN, a run's folder, sweep=DIR, a sweep's, and runs=A,B, "
            "two runs' folders"
        )
    ((kind, value),) = given.items()
    folder, command = Path(str(value)), typed("report", **{kind: value})
    if kind != "runs":
        check_links(folder)
    if kind == "run":
        record = with_todays_names(read_run(folder))
        page = make_run_page(record, compared(record), command)
    elif kind == "runs":
        first, second = map(with_todays_names, read_two_runs(str(value)))
        check_links(first.folder)
        check_links(second.folder)
        page, folder = make_comparison_page(first, second, command), second.folder
    else:
        found = read_sweep(folder)
        winner = folder / find_best_job(found).folder
        there = (winner / "metrics.json").is_file()
        best = with_todays_names(read_run(winner)) if there else None
        page = make_sweep_page(found, best, compared(best) if best else None, command)
    own = folder / ("comparison" if kind == "runs" else "report")
    out = Path(str(job.cfg.out or own))
    charts = write_page(page, out)
    if not job.cfg.out:  # the folder is this command's own: what an earlier page had goes
        for earlier in {*out.glob("*.png")} - {out / name for name in charts}:
            earlier.unlink()
    files = {"report": out / "report.html", f"{len(charts)} charts": out}
    ended(job.cfg.console, "reported", files)


def write_page(page: Page, folder: Path) -> list[str]:
    """Write a page, and its charts as pictures; return their names."""
    write_whole(folder / "report.html", page.render())
    files = page.files()
    for name, png in files.items():
        write_whole(folder / name, png)
    return [*files]


def with_todays_names(run: Run) -> Run:
    """Return a run of an earlier version as one of this, so that no renaming is a difference."""
    upgraded = upgrade({"choices": run.choices, "settings": run.config})
    return replace(
        run,
        config=upgraded["settings"],
        choices=upgraded["choices"],
        overrides=[update(one, "train") for one in run.overrides],
    )


def compared(run: Run) -> list[Change] | None:
    """Return how a run's settings differ from its method's defaults; None where these can no longer
    be composed.
    """
    said = [
        f"{key}={run.choices[key]}"
        for key in ("model", "variant")
        if re.fullmatch(r"\w+", run.choices.get(key, ""))
    ]
    if not run.config:
        return None
    loader = GlobalHydra.instance().config_loader()
    try:
        default = to_plain(loader.load_configuration("train", said, RunMode.RUN))
    # the run is of another version, whose choices are gone
    except (HydraException, OmegaConfBaseException):
        return None
    default.pop("hydra", None)
    return compare_settings(run.config, default)
