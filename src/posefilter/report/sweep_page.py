"""Lay a sweep out on one page."""

from collections.abc import Sequence
from html import escape

from posefilter.report import html
from posefilter.report.charts import Line, Panel
from posefilter.report.gather import Run
from posefilter.report.images import group_by_section
from posefilter.report.panels import PERCENT, SHARE
from posefilter.report.run_page import settings, tiles, worst_and_best
from posefilter.report.settings import Change
from posefilter.report.sweeps import Group, Job, Sweep, find_best_group, find_best_job, group_jobs

FIGURES = (  # name, title, unit, limits, format
    ("add/auc", "ADD AUC", "", PERCENT, "{:.1f}"),
    ("add_s/auc", "ADD-S AUC", "", PERCENT, "{:.1f}"),
    ("add/recall_01d", "ADD < 0.1 diameter", "%", PERCENT, "{:.1f}"),
    ("add/median_mm", "Median ADD", "mm", None, "{:.1f}"),
    ("iou", "Box IoU", "", SHARE, "{:.3f}"),
    ("particles_on_object", "On the object", "share", SHARE, "{:.3f}"),
    ("seconds_per_image", "Time an image", "s", None, "{:.3g}"),
)
MOST_LINES = 6  # values of a second axis that become lines, settings that get a name


def sweep_page(
    sweep: Sweep, best: Run | None, changed: Sequence[Change] | None, command: str
) -> tuple[str, dict[str, bytes]]:
    """Return the page, and its charts as PNGs by file name.

    best: the best run as read from its folder, None where only the summary is left; changed: as for a run's page.
    """
    found = group_jobs(sweep)
    names = [name for name, *_ in FIGURES if any(name in job.numbers for job in sweep.jobs)]
    plots, files = "", dict[str, bytes]()
    for axis in sweep.shown:
        content, pngs = html.charts(over(axis, sweep, found, names))
        plots, files = plots + (f"<h3>{escape(axis)}</h3>{content}" if content else ""), files | pngs
    cost, more = html.charts(against_time(found))
    winner = find_best_job(sweep)
    sections = [
        ("Table", table(sweep, found, names)),
        ("Over the swept settings", plots),
        ("Quality against time", cost),
        ("Spread over seeds", seeds(found, names)),
        ("Best run", best_run(winner, best, changed)),
        ("Single runs", singles(sweep, names) if len(found) < len(sweep.jobs) else ""),
    ]
    return html.page(
        f"Sweep {sweep.folder.resolve().name}", head(sweep, winner, best), sections, f"Made with {html.code(command)}."
    ), {
        **files,
        **more,
    }


def head(sweep: Sweep, winner: Job, best: Run | None) -> str:
    """Return what is read first."""
    over_what = ", ".join(f"{axis} ({len(sweep.values(axis))})" for axis in sweep.axes) or "nothing"
    left = [f"Without a result: {', '.join(sweep.unfinished)}."] if sweep.unfinished else []
    if best is None:
        left.append("The runs themselves are not there: figures are those of summary.csv.")
    count = f"{len(sweep.jobs)} of {len(sweep.jobs) + len(sweep.unfinished)}" if sweep.unfinished else str(len(sweep.jobs))
    badge = f'<span class="badge {"bad" if sweep.unfinished else "done"}">{count} runs</span>'
    return (
        f"<h1>Sweep over {escape(over_what)}</h1><p>{badge} best: {html.code(told(winner.place) or winner.folder)}<br>"
        f"{html.code(str(sweep.folder))}</p>" + (tiles(best) if best else "") + html.notes(left)
    )


def told(place: dict[str, int | float | str]) -> str:
    """Return a place among the axes as it would be typed."""
    return " ".join(f"{axis}={value}" for axis, value in place.items())


def table(sweep: Sweep, found: Sequence[Group], names: Sequence[str]) -> str:
    """Return a row a setting: means, with half the range over seeds."""
    shown = [entry for entry in FIGURES if entry[0] in names]
    rows = [
        (
            *(html.code(str(group.place[axis])) for axis in sweep.shown),
            str(len(group.jobs)),
            *(mean_and_half_range(group.of(name), form) for name, _, _, _, form in shown),
        )
        for group in found
    ]
    titles = [
        *map(escape, sweep.shown),
        "runs",
        *(f"{escape(title)}{f' [{unit}]' if unit else ''}" for _, title, unit, _, _ in shown),
    ]
    start = len(sweep.shown)
    say = "<p>The best is marked. Where there are several seeds: mean ± half the range from the worst to the best.</p>"
    return say + html.table(titles, rows, numeric=range(start, len(titles)), marked=find_best_group(found), kind="sweep")


def mean_and_half_range(values: Sequence[float], form: str) -> str:
    """Return numbers as one cell."""
    if not values:
        return "–"
    mean = form.format(sum(values) / len(values))
    return mean if len(values) == 1 else f"{mean} ± {form.format((max(values) - min(values)) / 2)}"


def over(axis: str, sweep: Sweep, found: Sequence[Group], names: Sequence[str]) -> list[Panel]:
    """Return a chart for each figure over one axis; another axis of few values becomes lines."""
    values = sweep.values(axis)
    if len(values) < 2:
        return []
    numeric = not any(isinstance(value, str) for value in values)
    spots = {value: float(value) if numeric else float(i) for i, value in enumerate(values)}
    others = [other for other in sweep.shown if other != axis and 1 < len(sweep.values(other)) <= MOST_LINES]
    kinds = [(others[0], value) for value in sweep.values(others[0])] if others else [None]
    low = min(spots.values())
    log_x = numeric and low > 0 and max(spots.values()) / low >= 8
    out = []
    for name, title, unit, limits, _ in FIGURES:
        if name not in names:
            continue
        lines = [
            line_over(axis, spots, [g for g in found if kind is None or g.place[kind[0]] == kind[1]], name, kind)
            for kind in kinds
        ]
        lines = [line for line in lines if len(line.x)]
        if lines:
            out.append(Panel(title, axis, unit, lines, limits, () if numeric else [str(v) for v in values], log_x))
    return out


def line_over(
    axis: str,
    spots: dict[int | float | str, float],
    found: Sequence[Group],
    name: str,
    kind: tuple[str, int | float | str] | None,
) -> Line:
    """Return means over an axis with the range, and single runs, of some groups."""
    at = {spot: [y for g in found if g.place[axis] == value for y in g.of(name)] for value, spot in spots.items()}
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


def against_time(found: Sequence[Group]) -> list[Panel]:
    """Return quality against what it costs, a dot a setting."""
    if len(found) < 2:
        return []
    for name, title, unit, limits, _ in (FIGURES[0], FIGURES[5]):  # what sweeps maximise: the one, or else the other
        pairs = [(group, group.of("seconds_per_image"), group.of(name)) for group in found]
        lines = [Line(told(g.place), [sum(x) / len(x)], [sum(y) / len(y)]) for g, x, y in pairs if x and y]
        if len(lines) > MOST_LINES:  # too many for a legend: the table tells them apart
            lines = [Line("a setting", [line.x[0] for line in lines], [line.y[0] for line in lines])]
        if lines:
            return [Panel(title, "time an image [s]", unit, lines, limits, joined=False)]
    return []


def seeds(found: Sequence[Group], names: Sequence[str]) -> str:
    """Return how far seeds lie apart, setting by setting; nothing where there is one seed each."""
    shown = [entry for entry in FIGURES[:-1] if entry[0] in names][:4]
    several = [group for group in found if len(group.jobs) > 1]
    if not several and len(found) > 1 and list(found[0].place) == ["seed"]:
        several = [Group({}, [job for group in found for job in group.jobs])]
    rows = [
        (
            html.code(told(group.place) or "all"),
            str(len(group.jobs)),
            *(spread(group.of(name), form) for name, _, _, _, form in shown),
        )
        for group in several
    ]
    titles = ("setting", "runs", *(escape(title) for _, title, *_ in shown))
    return html.table(titles, rows, numeric=range(1, len(titles)), kind="sweep")


def spread(values: Sequence[float], form: str) -> str:
    """Return the worst and the best of some numbers, and their standard deviation."""
    if len(values) < 2:
        return "–"
    mean = sum(values) / len(values)
    deviation = (sum((value - mean) ** 2 for value in values) / (len(values) - 1)) ** 0.5
    return f"{form.format(min(values))} to {form.format(max(values))} (sd {form.format(deviation)})"


def best_run(winner: Job, best: Run | None, changed: Sequence[Change] | None) -> str:
    """Return the best run's place, pictures and settings."""
    out = f"<p>{html.code(told(winner.place))}<br>{html.code(winner.folder)}</p>"
    if best is None:
        return out
    return out + worst_and_best(group_by_section(best.pictures)) + "<h3>Its settings</h3>" + settings(best, changed)


def singles(sweep: Sweep, names: Sequence[str]) -> str:
    """Return every run, folded away."""
    shown = [entry for entry in FIGURES if entry[0] in names]
    rows = [
        (
            *(html.code(str(job.place[axis])) for axis in sweep.axes),
            *(form.format(job.numbers[name]) if name in job.numbers else "–" for name, _, _, _, form in shown),
        )
        for job in sweep.jobs
    ]
    titles = [*map(escape, sweep.axes), *(escape(title) for _, title, *_ in shown)]
    return html.fold(
        f"All {len(rows)} runs", html.table(titles, rows, numeric=range(len(sweep.axes), len(titles)), kind="sweep")
    )
