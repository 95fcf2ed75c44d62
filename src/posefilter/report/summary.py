"""Draw what a sweep found on one figure: each metric over each swept setting, a dot a run."""

from collections.abc import Mapping, Sequence
from statistics import mean
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from posefilter.metrics.registry import MetricInfo, find_metric
from posefilter.report.charts import LIGHT, MOST_TICKS, shorten
from posefilter.report.sweeps import COLUMNS

SHOWN = ("add_auc", "iou", "particles_on_object", "seconds_per_image")
_COLOR = LIGHT.lines[0]
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
            dots = [
                (row[key], info.convert(row[name])) for row in rows if row.get(name) is not None
            ]
            panel.grid(alpha=0.3)
            panel.set_title(info.title, fontsize=11, loc="left")
            if key in words:
                draw_over_words(panel, dots, values[key], info, joined=not once)
                panel.tick_params(labelleft=panel is line[0])
                panel.set_ylabel(key if panel is line[0] else "")
            else:
                draw_over_numbers(panel, dots, values[key], info, joined=not once)
                panel.set_xlabel(key)
    return figure


def draw_over_numbers(
    panel: Axes,
    dots: Sequence[tuple[float, float]],
    values: Sequence[float],
    info: MetricInfo,
    joined: bool,
) -> None:
    """Draw a metric over a number; ticks stand at the values that were tried."""
    at = {x: mean(y for own, y in dots if own == x) for x in sorted({x for x, _ in dots})}
    if joined:
        panel.plot(list(at), list(at.values()), "-", color=_COLOR)
    panel.plot(*zip(*dots, strict=True), "o", color=_COLOR, alpha=0.6)
    if min(values) > 0 and max(values) / min(values) >= 8:
        panel.set_xscale("log")
    if len(values) <= MOST_TICKS:
        panel.set_xticks(sorted(values), [f"{x:g}" for x in sorted(values)])
        panel.xaxis.set_minor_locator(NullLocator())
    panel.set_ylim(*(info.limits or (0, 1.1 * max(y for _, y in dots) or 1)))


def draw_over_words(
    panel: Axes,
    dots: Sequence[tuple[str, float]],
    values: Sequence[str],
    info: MetricInfo,
    joined: bool,
) -> None:
    """Draw a metric over words, from the top as they were typed."""
    places = {value: place for place, value in enumerate(values)}
    if joined:
        means = {x: mean(y for own, y in dots if own == x) for x, _ in dots}
        panel.barh(
            [places[x] for x in means], list(means.values()), height=0.7, color=_COLOR, alpha=0.25
        )
    panel.plot([y for _, y in dots], [places[x] for x, _ in dots], "o", color=_COLOR, alpha=0.6)
    panel.set_yticks(list(places.values()), [shorten(str(value), 32) for value in places])
    panel.set_ylim(len(places) - 0.5, -0.5)
    panel.set_xlim(*(info.limits or (0, 1.1 * max(y for _, y in dots) or 1)))
