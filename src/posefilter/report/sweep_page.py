"""Lay a sweep out on one page."""

from collections.abc import Sequence
from dataclasses import replace
from statistics import mean, stdev

from posefilter.metrics.registry import MetricInfo, find_metric
from posefilter.report.blocks import (
    Block,
    Cell,
    Fold,
    Heading,
    Paragraph,
    Section,
    Table,
    Text,
    draw_charts,
)
from posefilter.report.gather import Run
from posefilter.report.images import group_by_section
from posefilter.report.page import Page
from posefilter.report.run_page import list_settings, make_tiles, show_worst_and_best
from posefilter.report.settings import Change
from posefilter.report.sweep_charts import chart_against_time, chart_over, name_axis, spell
from posefilter.report.sweeps import (
    COLUMNS,
    DETECTING,
    Group,
    Job,
    Sweep,
    are_detectors,
    find_best_group,
    find_best_job,
    find_median,
    find_ties,
    group_jobs,
    list_judging,
)  # fmt: skip


def make_sweep_page(
    sweep: Sweep, best: Run | None, changed: Sequence[Change] | None, command: str
) -> Page:
    """Return what a sweep's page says.

    Args:
        sweep: Its runs.
        best: The best run as read from its folder, None where only the summary is left.
        changed: As for a run's page, of the best run.
        command: What made the page.
    """
    found = group_jobs(sweep)
    infos = list_metrics(sweep)
    plots: list[Block] = []
    for axis in sweep.shown:
        charts = draw_charts(chart_over(axis, sweep, found, infos))
        plots += [Heading(name_axis(axis, sweep)), *note_seeds(found), *charts] if charts else []
    winner = find_best_job(sweep)
    sections = [
        Section("Table", tabulate_groups(sweep, found, infos)),
        Section("Over the swept settings", plots),
        Section("Quality against time", draw_charts(chart_against_time(found))),
        Section("Spread over seeds", tabulate_seeds(found, infos)),
        Section("Best run", show_best(winner, best, changed)),
        Section("Single runs", list_jobs(sweep, infos) if len(found) < len(sweep.jobs) else []),
    ]
    over_what = ", ".join(f"{axis} ({len(sweep.values(axis))})" for axis in sweep.axes) or "nothing"
    foot = Paragraph(["Made with", Text(command, "code")])
    title = f"Sweep {sweep.folder.resolve().name}"
    # of one run: where a setting has several, its mean is what counts
    alone = all(len(group.jobs) == 1 for group in found) or not sweep.shown
    tiles = []
    if best and alone:  # the run's own test, as in the table, also where an evaluation came after
        tiles = make_tiles(replace(best, metrics=best.metrics_train or best.metrics))
    heading, lines = f"Sweep over {over_what}", head_lines(sweep, winner)
    return Page(title, heading, lines, tiles, list_notes(sweep, best), sections, foot)


def list_metrics(sweep: Sweep) -> list[MetricInfo]:
    """Return what the runs have numbers of."""
    known = {key for job in sweep.jobs for key in job.numbers}
    return [find_metric(key) for key in COLUMNS.values() if key in known]


def head_lines(sweep: Sweep, winner: Job) -> list[Paragraph]:
    """Return what stands below the heading: how many runs, which is the best, where they are."""
    done, left = len(sweep.jobs), len(sweep.unfinished)
    badge = Text(f"{done} of {done + left} runs", "badge") if left else Text(f"{done} runs", "done")
    return [
        Paragraph([badge, "best:", *name_best(sweep, winner)]),
        Paragraph([Text(str(sweep.folder), "code")]),
    ]


def name_best(sweep: Sweep, winner: Job) -> list[Cell]:
    """Return which setting is the best: by the mean over its seeds where it has several, else by
    its run.
    """
    found, as_detectors = group_jobs(sweep), are_detectors(sweep.jobs)
    group = found[find_best_group(found)]
    if sweep.shown and len(group.jobs) > 1:
        infos = map(find_metric, DETECTING if as_detectors else list_judging(group.jobs))
        figures = [f"{info.label} {format_mean(group, info)}" for info in infos]
        why = f"({', '.join([*figures, f'mean of {len(group.jobs)} seeds'])})"
        return [Text(spell(group.place), "code"), Text(why, "soft")]
    tied = find_ties(sweep)
    median = None if as_detectors else find_median(winner)
    why = f"has the least {find_metric(median[0]).label}" if median else "is the first of them"
    ties = f"({tied} runs have its score to one decimal; it {why})"
    name = Text(spell(winner.place) or winner.folder, "code")
    return [name, Text(ties, "soft")] if tied > 1 else [name]


def list_notes(sweep: Sweep, best: Run | None) -> list[str]:
    """Return what a reader should know first: which runs have no result and why, by what the best
    was found where the runs are of several kinds, and whether they themselves are there.
    """
    causes = {job.folder: job.error for job in sweep.failed}
    open_ended = [folder for folder in sweep.unfinished if folder not in causes]
    notes = [f"Without a result: {', '.join(open_ended)}."] if open_ended else []
    notes += [f"Failed: {folder}: {cause}" for folder, cause in causes.items()]
    if are_detectors(sweep.jobs):
        notes.append(
            "Some runs predict no pose, and their score does not compare with an ADD AUC: the best "
            "of all is by the mean of the particles on the object and the box's IoU."
        )
    if not best:
        notes.append("The runs themselves are not there: numbers are those of summary.csv.")
    return notes


def tabulate_groups(
    sweep: Sweep, found: Sequence[Group], infos: Sequence[MetricInfo]
) -> list[Block]:
    """Return a row a setting: means, with the standard deviation over seeds."""
    rows = list[list[Cell]]()
    for group in found:
        place = [Text(str(group.place[axis]), "code") for axis in sweep.shown]
        numbers = [format_mean(group, info) for info in infos]
        rows.append([*place, str(len(group.jobs)), *numbers])
    head = [*sweep.shown, "runs", *(info.title for info in infos)]
    several = "Where there are several seeds: mean ± standard deviation of the sample."
    numeric = range(len(sweep.shown), len(head))
    table = Table(head, rows, numeric, marked=find_best_group(found), form="sweep")
    return [Paragraph([f"The best is marked. {several}"]), table]


def format_mean(group: Group, info: MetricInfo) -> str:
    """Return numbers of several seeds as one cell; where not all have one, of how many it is."""
    values = group.of(info.key)
    if not values:
        return "–"
    spread = f" ± {info.format(stdev(values))}" if len(values) > 1 else ""
    return info.format(mean(values)) + spread + _note_missing(group, values)


def _note_missing(group: Group, values: Sequence[float]) -> str:
    """Return of how many runs a figure is; a median of images mostly missed, for one, is none."""
    return f" ({len(values)} of {len(group.jobs)})" if len(values) < len(group.jobs) else ""


def note_seeds(found: Sequence[Group]) -> list[Block]:
    """Return a caveat where every setting was run with one seed: two numbers are no trend."""
    if any(len(group.jobs) > 1 or [*group.place] == ["seed"] for group in found):
        return []
    said = "One seed each: differences may be chance. Add seed=0,1,2 to the sweep to see."
    return [Paragraph([Text(said, "soft")])]


def tabulate_seeds(found: Sequence[Group], infos: Sequence[MetricInfo]) -> list[Block]:
    """Return how far seeds lie apart, setting by setting; nothing where there is one seed each."""
    shown = [info for info in infos if info.key != "seconds_per_image"][:4]
    several = [group for group in found if len(group.jobs) > 1]
    if not several and len(found) > 1 and list(found[0].place) == ["seed"]:
        several = [Group({}, [job for group in found for job in group.jobs])]
    rows = list[list[Cell]]()
    for group in several:
        spreads = [format_spread(group, info) for info in shown]
        rows.append([Text(spell(group.place) or "all", "code"), str(len(group.jobs)), *spreads])
    head = ("setting", "runs", *(info.title for info in shown))
    return [Table(head, rows, numeric=range(1, len(head)), form="sweep")]


def format_spread(group: Group, info: MetricInfo) -> str:
    """Return the least and the greatest of a group's numbers, and their standard deviation."""
    values = group.of(info.key)
    if len(values) < 2:
        return "–"
    low, high, sd = (info.format(x) for x in (min(values), max(values), stdev(values)))
    return f"{low} to {high} (sd {sd}){_note_missing(group, values)}"


def show_best(winner: Job, best: Run | None, changed: Sequence[Change] | None) -> list[Block]:
    """Return the best run's place, images and settings."""
    where: list[Block] = [
        Paragraph([Text(spell(winner.place), "code")]),
        Paragraph([Text(winner.folder, "code")]),
    ]
    if best is None:
        return where
    images = show_worst_and_best(group_by_section(best.pictures))
    return [*where, *images, Heading("Its settings"), *list_settings(best, changed)]


def list_jobs(sweep: Sweep, infos: Sequence[MetricInfo]) -> list[Block]:
    """Return every run, folded away."""
    rows = list[list[Cell]]()
    for job in sweep.jobs:
        place = [Text(str(job.place[axis]), "code") for axis in sweep.axes]
        known = job.numbers
        numbers = [info.format(known[info.key]) if info.key in known else "–" for info in infos]
        rows.append([*place, *numbers])
    head = [*sweep.axes, *(info.title for info in infos)]
    table = Table(head, rows, range(len(sweep.axes), len(head)), form="sweep")
    return [Fold(f"All {len(rows)} runs", [table])]
