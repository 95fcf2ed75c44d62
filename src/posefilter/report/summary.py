"""Draw what a sweep found on one figure: each metric over each swept setting, a dot a run."""

from collections.abc import Mapping, Sequence
from statistics import mean
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from posefilter.metrics.registry import find_metric
from posefilter.report.charts import LIGHT, MOST_TICKS, shorten
from posefilter.report.sweeps import COLUMNS

SHOWN = ("add_auc", "iou", "particles_on_object", "seconds_per_image")
Row = Mapping[str, Any]


def draw_summary(rows: Sequence[Row], axes: Sequence[str]) -> Figure:
    """Draw quality and cost over each swept setting.

    Dots are runs.  Where settings were run with several seeds, their means are joined by a line
    (numbers) or drawn as bars (words).  Where each was run once nothing is joined, and the title
    says so: one seed is no trend.

    Args:
        rows: A row of summary.csv each: settings, and metrics by their column's name.
        axes: The swept settings, the seed among them.
    """
    columns = [name for name in SHOWN if any(row.get(name) is not None for row in rows)]
    swept = [key for key in axes if key != "seed"] or list(axes) or ["folder"]
    values = {key: list(dict.fromkeys(row[key] for row in rows)) for key in swept}
    words = {key for key in swept if any(isinstance(value, str) for value in values[key])}
    once = len({tuple(row[key] for key in swept) for row in rows}) == len(rows)
    heights = [max(3.2, 1.2 + 0.26 * len(values[key])) if key in words else 3.2 for key in swept]
    figure = Figure(
        figsize=(max(4.2 * len(columns), 6.0), sum(heights) + 0.9), layout="constrained"
    )
    FigureCanvasAgg(figure)
    count = f"{len(rows)} run{'s' * (len(rows) != 1)}"
    notes = (
        "one seed each: differences may be chance"
        if once
        else "line or bar: mean over seeds; dots: runs"
    )
    figure.suptitle(
        f"Sweep over {', '.join(swept)}: {count}\n{notes}", fontsize=12, fontweight="bold"
    )
    panels = figure.subplots(len(swept), len(columns), squeeze=False, height_ratios=heights)
    for line, key in zip(panels, swept, strict=True):
        for panel, name in zip(line, columns, strict=True):
            info = find_metric(COLUMNS[name])
            panel.grid(alpha=0.3)
            panel.set_title(info.title, fontsize=11, loc="left")
            draw = draw_over_words if key in words else draw_over_numbers
            ends = [info.convert(row[name]) for row in rows if row.get(name) is not None]
            limits = info.limits or (0.0, 1.1 * max(ends) or 1.0)
            for number, (label, own) in enumerate(split_rows(rows, key, swept).items()):
                dots = [
                    (row[key], info.convert(row[name])) for row in own if row.get(name) is not None
                ]
                if dots:
                    draw(panel, dots, values[key], limits, LIGHT.lines[number], label, not once)
            if panel is line[0] and panel.get_legend_handles_labels()[1]:
                panel.legend(fontsize=8)
            if key in words:
                panel.tick_params(labelleft=panel is line[0])
                panel.set_ylabel(key if panel is line[0] else "")
            else:
                panel.set_xlabel(key)
    return figure


def split_rows(rows: Sequence[Row], key: str, swept: Sequence[str]) -> dict[str, list[Row]]:
    """Return the rows by another swept setting of few values, which gets colors; else all as
    one.
    """
    others = [other for other in swept if other != key]
    few = [other for other in others if len({row[other] for row in rows}) <= len(LIGHT.lines)]
    out: dict[str, list[Row]] = {}
    for row in rows:
        out.setdefault(f"{few[0]}={row[few[0]]}" if few else "", []).append(row)
    return out


def draw_over_numbers(
    panel: Axes,
    dots: Sequence[tuple[float, float]],
    values: Sequence[float],
    limits: tuple[float, float],
    color: str,
    label: str,
    joined: bool,
) -> None:
    """Draw a metric over a number; ticks stand at the values that were tried."""
    at = {x: mean(y for own, y in dots if own == x) for x in sorted({x for x, _ in dots})}
    if joined:
        panel.plot(list(at), list(at.values()), "-", color=color)
    panel.plot(*zip(*dots, strict=True), "o", color=color, alpha=0.6, label=label)
    if min(values) > 0 and max(values) / min(values) >= 8:
        panel.set_xscale("log")
    if len(values) <= MOST_TICKS:
        panel.set_xticks(sorted(values), [f"{x:g}" for x in sorted(values)])
        panel.xaxis.set_minor_locator(NullLocator())
    panel.set_ylim(*limits)


def draw_over_words(
    panel: Axes,
    dots: Sequence[tuple[str, float]],
    values: Sequence[str],
    limits: tuple[float, float],
    color: str,
    label: str,
    joined: bool,
) -> None:
    """Draw a metric over words, from the top as they were typed."""
    places = {value: place for place, value in enumerate(values)}
    if joined:
        means = {x: mean(y for own, y in dots if own == x) for x, _ in dots}
        spots = [places[x] for x in means]
        if label:  # bars of several colors would hide each other
            panel.plot(
                list(means.values()), spots, "|", color=color, markersize=22, markeredgewidth=2
            )
        else:
            panel.barh(spots, list(means.values()), height=0.7, color=color, alpha=0.25)
    spots = [places[x] for x, _ in dots]
    panel.plot([y for _, y in dots], spots, "o", color=color, alpha=0.6, label=label)
    panel.set_yticks(list(places.values()), [shorten(str(value), 32) for value in places])
    panel.set_ylim(len(places) - 0.5, -0.5)
    panel.set_xlim(*limits)
