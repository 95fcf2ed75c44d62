"""Lay a sweep out on one page."""

from collections.abc import Mapping, Sequence
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
from posefilter.report.charts import Line, Panel
from posefilter.report.gather import Run
from posefilter.report.images import group_by_section
from posefilter.report.page import Page
from posefilter.report.run_page import list_settings, make_tiles, show_worst_and_best
from posefilter.report.settings import Change
from posefilter.report.sweeps import (
    COLUMNS,
    Group,
    Job,
    Sweep,
    Value,
    find_best_group,
    find_best_job,
    find_ties,
    group_jobs,
)  # fmt: skip

MOST_LINES = 6  # values of a second axis that become lines, settings that get a name


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
        plots += [Heading(axis), *note_seeds(found), *charts] if charts else []
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
    title, tiles = f"Sweep {sweep.folder.resolve().name}", make_tiles(best) if best else []
    return Page(
        title,
        f"Sweep over {over_what}",
        head_lines(sweep, winner),
        tiles,
        list_notes(sweep, best),
        sections,
        foot,
    )


def list_metrics(sweep: Sweep) -> list[MetricInfo]:
    """Return what the runs have numbers of."""
    return [
        find_metric(key)
        for key in COLUMNS.values()
        if any(key in job.numbers for job in sweep.jobs)
    ]


def head_lines(sweep: Sweep, winner: Job) -> list[Paragraph]:
    """Return what stands below the heading: how many runs, which is the best, where they are."""
    count = (
        f"{len(sweep.jobs)} of {len(sweep.jobs) + len(sweep.unfinished)}"
        if sweep.unfinished
        else str(len(sweep.jobs))
    )
    badge = Text(f"{count} runs", "badge" if sweep.unfinished else "done")
    tied = find_ties(sweep)
    why = (
        [Text(f"({tied} runs have its score to one decimal; it has the least median ADD)", "soft")]
        if tied > 1
        else []
    )
    name = Text(spell(winner.place) or winner.folder, "code")
    return [Paragraph([badge, "best:", name, *why]), Paragraph([Text(str(sweep.folder), "code")])]


def list_notes(sweep: Sweep, best: Run | None) -> list[str]:
    """Return what a reader should know first: which runs have no result, and whether the runs
    themselves are there.
    """
    notes = [f"Without a result: {', '.join(sweep.unfinished)}."] if sweep.unfinished else []
    return (
        notes
        if best
        else [*notes, "The runs themselves are not there: numbers are those of summary.csv."]
    )


def spell(place: Mapping[str, Value]) -> str:
    """Return a place among the axes as it would be typed."""
    return " ".join(f"{axis}={value}" for axis, value in place.items())


def tabulate_groups(
    sweep: Sweep, found: Sequence[Group], infos: Sequence[MetricInfo]
) -> list[Block]:
    """Return a row a setting: means, with half the range over seeds."""
    rows: list[list[Cell]] = [
        [
            *(Text(str(group.place[axis]), "code") for axis in sweep.shown),
            str(len(group.jobs)),
            *(format_mean(group.of(info.key), info) for info in infos),
        ]
        for group in found
    ]
    head = [*sweep.shown, "runs", *(info.title for info in infos)]
    say = (
        "The best is marked. Where there are several seeds: mean ± half the range from the worst "
        "to the best."
    )
    numeric = range(len(sweep.shown), len(head))
    return [
        Paragraph([say]),
        Table(head, rows, numeric, marked=find_best_group(found), form="sweep"),
    ]


def format_mean(values: Sequence[float], info: MetricInfo) -> str:
    """Return numbers of several seeds as one cell."""
    if not values:
        return "–"
    half = (max(values) - min(values)) / 2
    return info.format(mean(values)) + ("" if len(values) == 1 else f" ± {info.format(half)}")


def note_seeds(found: Sequence[Group]) -> list[Block]:
    """Return a caveat where every setting was run with one seed: two numbers are no trend."""
    if any(len(group.jobs) > 1 for group in found):
        return []
    return [
        Paragraph(
            [
                Text(
                    "One seed each: differences may be chance. Add seed=0,1,2 to the sweep to see.",
                    "soft",
                )
            ]
        )
    ]


def chart_over(
    axis: str, sweep: Sweep, found: Sequence[Group], infos: Sequence[MetricInfo]
) -> list[Panel]:
    """Return a chart for each metric over one axis; another axis of few values becomes lines."""
    values = sweep.values(axis)
    if len(values) < 2:
        return []
    numeric = not any(isinstance(value, str) for value in values)
    spots = {value: float(value) if numeric else float(i) for i, value in enumerate(values)}
    others = [
        other
        for other in sweep.shown
        if other != axis and 1 < len(sweep.values(other)) <= MOST_LINES
    ]
    kinds = [(others[0], value) for value in sweep.values(others[0])] if others else [None]
    low = min(spots.values())
    log_x = numeric and low > 0 and max(spots.values()) / low >= 8
    out = []
    for info in infos:
        lines = [
            line_over(
                axis,
                spots,
                [g for g in found if kind is None or g.place[kind[0]] == kind[1]],
                info,
                kind,
            )
            for kind in kinds
        ]
        lines = [line for line in lines if len(line.x)]
        if lines:
            categories = () if numeric else [str(v) for v in values]
            out.append(
                Panel(
                    info.label,
                    axis,
                    info.unit,
                    lines,
                    info.limits,
                    categories,
                    log_x,
                    ticks=tuple(spots.values()),
                )
            )
    return out


def line_over(
    axis: str,
    spots: Mapping[Value, float],
    found: Sequence[Group],
    info: MetricInfo,
    kind: tuple[str, Value] | None,
) -> Line:
    """Return means over an axis with the range, and single runs, of some groups."""
    at = {
        spot: [info.convert(y) for g in found if g.place[axis] == value for y in g.of(info.key)]
        for value, spot in spots.items()
    }
    at = {spot: ys for spot, ys in at.items() if ys}
    several = any(len(ys) > 1 for ys in at.values())
    return Line(
        f"{kind[0]}={kind[1]}" if kind else "mean",
        list(at),
        [sum(ys) / len(ys) for ys in at.values()],
        [min(ys) for ys in at.values()] if several else (),
        [max(ys) for ys in at.values()] if several else (),
        [(spot, y) for spot, ys in at.items() for y in ys] if several else (),
    )


def chart_against_time(found: Sequence[Group]) -> list[Panel]:
    """Return quality against what it costs, a dot a setting."""
    if len(found) < 2:
        return []
    cost = find_metric("seconds_per_image")
    # what sweeps maximize: the one, or else the other
    for info in map(find_metric, ("add/auc", "particles_on_object")):
        pairs = [
            (group, group.of(cost.key), [info.convert(y) for y in group.of(info.key)])
            for group in found
        ]
        lines = [Line(spell(g.place), [mean(x)], [mean(y)]) for g, x, y in pairs if x and y]
        if len(lines) > MOST_LINES:  # too many for a legend: the table tells them apart
            lines = [
                Line("a setting", [line.x[0] for line in lines], [line.y[0] for line in lines])
            ]
        if lines:
            return [Panel(info.label, cost.title, info.unit, lines, info.limits, joined=False)]
    return []


def tabulate_seeds(found: Sequence[Group], infos: Sequence[MetricInfo]) -> list[Block]:
    """Return how far seeds lie apart, setting by setting; nothing where there is one seed each."""
    shown = [info for info in infos if info.key != "seconds_per_image"][:4]
    several = [group for group in found if len(group.jobs) > 1]
    if not several and len(found) > 1 and list(found[0].place) == ["seed"]:
        several = [Group({}, [job for group in found for job in group.jobs])]
    rows: list[list[Cell]] = [
        [
            Text(spell(group.place) or "all", "code"),
            str(len(group.jobs)),
            *(format_spread(group.of(info.key), info) for info in shown),
        ]
        for group in several
    ]
    head = ("setting", "runs", *(info.title for info in shown))
    return [Table(head, rows, numeric=range(1, len(head)), form="sweep")]


def format_spread(values: Sequence[float], info: MetricInfo) -> str:
    """Return the least and the greatest of some numbers, and their standard deviation."""
    if len(values) < 2:
        return "–"
    low, high, sd = (info.format(x) for x in (min(values), max(values), stdev(values)))
    return f"{low} to {high} (sd {sd})"


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
    rows: list[list[Cell]] = [
        [
            *(Text(str(job.place[axis]), "code") for axis in sweep.axes),
            *(
                info.format(job.numbers[info.key]) if info.key in job.numbers else "–"
                for info in infos
            ),
        ]
        for job in sweep.jobs
    ]
    head = [*sweep.axes, *(info.title for info in infos)]
    return [
        Fold(
            f"All {len(rows)} runs",
            [Table(head, rows, range(len(sweep.axes), len(head)), form="sweep")],
        )
    ]
