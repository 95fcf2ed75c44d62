"""Charts of a sweep's page, and its summary: metrics over the swept settings and over time."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from statistics import mean

from matplotlib.figure import Figure

from posefilter.figures.canvas import create_figure
from posefilter.metrics.registry import MetricInfo, find_metric
from posefilter.report.charts import (
    LIGHT,
    WIDTH_PX,
    Line,
    Panel,
    count_columns,
    draw_panel,
    measure_height,
)
from posefilter.report.sweeps import (
    DETECTING,
    Group,
    Sweep,
    Value,
    find_auc,
    group_jobs,
    list_judging,
)

MOST_LINES = 6  # values of a second axis that become lines, settings that get a name
SUMMED = (*DETECTING, "seconds_per_image")  # beside what poses are scored by
_TITLE_PX = 60


def spell(place: Mapping[str, Value]) -> str:
    """Return a place among the axes as it would be typed."""
    return " ".join(f"{axis}={value}" for axis, value in place.items())


def chart_over(
    axis: str, sweep: Sweep, found: Sequence[Group], infos: Sequence[MetricInfo]
) -> list[Panel]:
    """Return a chart for each metric over one axis; another axis of few values becomes lines."""
    values = sweep.values(axis)
    if len(values) < 2:
        return []
    numeric = not any(isinstance(value, str) for value in values)
    spots = {value: float(value) if numeric else float(i) for i, value in enumerate(values)}
    other = choose_lines(axis, sweep)
    kinds = [None] if other is None else [(other, value) for value in sweep.values(other)]
    low = min(spots.values())
    log_x = numeric and low > 0 and max(spots.values()) / low >= 8
    ticks, categories = tuple(spots.values()), () if numeric else [str(v) for v in values]
    name = name_axis(axis, sweep)
    out = []
    for info in infos:
        lines = [line_over(axis, spots, found, info, kind) for kind in kinds]
        if shown := [line for line in lines if len(line.x)]:
            own = (info.label, name, info.unit, shown, info.limits, categories, log_x)
            out.append(Panel(*own, ticks=ticks))
    return out


def choose_lines(axis: str, sweep: Sweep) -> str | None:
    """Return the axis whose values become the lines of another's charts; None where none has few
    values.
    """
    few = (one for one in sweep.shown if one != axis and 1 < len(sweep.values(one)) <= MOST_LINES)
    return next(few, None)


def name_axis(axis: str, sweep: Sweep) -> str:
    """Return an axis as its charts are headed: with the others that they take the mean over."""
    lines = choose_lines(axis, sweep)
    rest = [x for x in sweep.shown if x not in (axis, lines) and len(sweep.values(x)) > 1]
    return f"{axis} (mean over {', '.join(rest)})" if rest else axis


def line_over(
    axis: str,
    spots: Mapping[Value, float],
    found: Sequence[Group],
    info: MetricInfo,
    kind: tuple[str, Value] | None,
) -> Line:
    """Return means over an axis with the range, and single runs, of all groups or of those that
    have a value on another axis.
    """
    own = [g for g in found if kind is None or g.place[kind[0]] == kind[1]]
    at = {
        spot: [info.convert(y) for g in own if g.place[axis] == value for y in g.of(info.key)]
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
    # what the best has most of; of detectors, the second part of it
    for info in map(find_metric, list_judging([job for one in found for job in one.jobs])[-1:]):
        lines = [
            Line(spell(one.place), [mean(x)], [mean(info.convert(value) for value in y)])
            for one in found
            if (x := one.of(cost.key)) and (y := one.of(info.key))
        ]
        if len(lines) > MOST_LINES:  # too many for a legend: the table tells them apart
            x, y = [line.x[0] for line in lines], [line.y[0] for line in lines]
            lines = [Line("a setting", x, y)]
        if lines:
            return [Panel(info.label, cost.title, info.unit, lines, info.limits, joined=False)]
    return []


def draw_summary(sweep: Sweep) -> Figure | None:
    """Draw quality and cost over each swept setting, as the charts of the sweep's page, on one
    figure.

    Where each setting was run once nothing is joined, and the title says so: one seed is no trend.

    Returns:
        The figure; None where no setting has been run with two values yet.
    """
    found = group_jobs(sweep)
    once = len(found) == len(sweep.jobs)
    auc = find_auc(sweep.jobs)
    infos = [find_metric(key) for key in (*([auc] if auc else []), *SUMMED)]
    charts = {axis: chart_over(axis, sweep, found, infos) for axis in sweep.shown}
    charts = {axis: row for axis, row in charts.items() if row}
    rows = [[replace(panel, joined=not once) for panel in row] for row in charts.values()]
    if not rows:
        return None
    columns = len(rows[0])
    # with room for a legend below each row
    heights = [measure_height(replace(row[0], joined=False)) for row in rows]
    figure = create_figure(columns * WIDTH_PX, sum(heights) + _TITLE_PX)
    figure.set_layout_engine("constrained")
    count = f"{len(sweep.jobs)} run{'s' * (len(sweep.jobs) != 1)}"
    notes = "line or large dot: mean over seeds; small dots: runs"
    if once:
        notes = "differences are those of seeds"
        if sweep.shown != ["seed"]:
            notes = "one seed each: differences may be chance"
    title = f"Sweep over {', '.join(sweep.shown)}: {count}\n{notes}"
    figure.suptitle(title, fontsize=12, fontweight="bold")
    parts = figure.subfigures(len(rows), squeeze=False, height_ratios=heights)[:, 0]
    for part, row in zip(parts, rows, strict=True):
        line = part.subplots(1, columns, squeeze=False)[0]
        for own, panel in zip(line, row, strict=True):
            draw_panel(own, panel, LIGHT)
        if row[0].categories:
            line[0].set_ylabel(row[0].xlabel, fontsize=8.5)
        if len(row[0].lines) > 1:
            style = {"fontsize": 8, "frameon": False, "ncols": columns * count_columns(row[0])}
            handles, labels = line[0].get_legend_handles_labels()
            part.legend(handles, labels, loc="outside lower left", **style)
    return figure
