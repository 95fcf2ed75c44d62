"""Draw small charts, each for light and for dark pages."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from itertools import takewhile
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, MaxNLocator, NullLocator
from PIL import Image

from posefilter.figures.canvas import create_figure, rasterize

WIDTH_PX, HEIGHT_PX, FINER = 380, 250, 2  # as shown; drawn at twice that for sharp screens
MOST_TICKS = 10  # swept values that are marked on an axis
_ENDS = "/. ,"  # of the words of a name
LONGEST_LABEL = 52  # of a legend, in characters
NOISY = 60  # points, from which on a line is drawn smoothed over its own faint self


class Theme(NamedTuple):
    """The colors of a page."""

    name: str
    paper: str
    ink: str
    soft: str
    lines: tuple[str, ...]


LIGHT = Theme(
    "light", "#ffffff", "#1c2430", "#8a93a3",
    ("#2563c9", "#d9650d", "#0f8a5f", "#a03bb0", "#b58900", "#5b6675"),
)  # fmt: skip
DARK = Theme(
    "dark", "#171b23", "#e4e8ef", "#7d8797",
    ("#7aa8ff", "#ffa657", "#4fcf9d", "#d79be6", "#e6cf6a", "#a5afbf"),
)  # fmt: skip


@dataclass(frozen=True)
class Line:
    """One line, or the dots of one kind."""

    label: str
    x: Sequence[float]
    y: Sequence[float]
    low: Sequence[float] = ()  # of a band about the line, where there is one
    high: Sequence[float] = ()
    dots: Sequence[tuple[float, float]] = ()  # single runs, whose mean the line is


@dataclass(frozen=True)
class Panel:
    """One chart.

    `categories`: names of 0, 1, ... along the side, instead of a horizontal axis of numbers.
    """

    title: str
    xlabel: str
    unit: str
    lines: Sequence[Line]
    limits: tuple[float, float] | None = None  # of y
    categories: Sequence[str] = ()
    log_x: bool = False
    joined: bool = True  # whether a line is one, or only its dots
    ticks: Sequence[float] = ()  # of x, where it is not free: the values that were tried
    log_y: bool = False
    diagonal: tuple[float, float] | None = None  # ends of a line along which both axes are equal


def draw_chart(panel: Panel, theme: Theme) -> bytes:
    """Return a chart as a PNG of few colors."""
    tall = measure_height(panel)
    figure = create_figure(WIDTH_PX * FINER, tall * FINER, dpi=100 * FINER)
    figure.set_layout_engine("constrained")
    figure.set_facecolor(theme.paper)
    axes = figure.subplots()
    draw_panel(axes, panel, theme)
    style: dict[str, Any] = {"labelcolor": theme.ink, "handlelength": 1.4, "borderaxespad": 0.2}
    style |= {"fontsize": 8, "frameon": False}
    if needs_legend_below(panel):
        figure.legend(loc="outside lower center", ncols=count_columns(panel), **style)
    elif len(panel.lines) > 1:
        axes.legend(loc="best", **style)
    return to_small_png(figure)


def draw_panel(axes: Axes, panel: Panel, theme: Theme) -> None:
    """Draw a chart into axes, but for its legend."""
    labels = distinguish([line.label for line in panel.lines], LONGEST_LABEL)
    for number, (line, label) in enumerate(zip(panel.lines, labels, strict=True)):
        line = replace(line, label=escape(label))
        color = theme.lines[number % len(theme.lines)]
        if panel.categories:
            draw_across(axes, line, color)
        else:
            draw_line(axes, line, color, panel.joined)
    style_axes(axes, panel, theme)


def needs_legend_below(panel: Panel) -> bool:
    """Tell whether a chart's legend stands below it, since it would hide what is drawn."""
    return len(panel.lines) > 1 and (
        bool(panel.categories) or len(panel.lines) > 4 or not panel.joined
    )


def count_columns(panel: Panel) -> int:
    """Return in how many columns a legend below a chart fits the chart's width."""
    return 2 if max(len(line.label) for line in panel.lines) <= 26 else 1


def measure_height(panel: Panel) -> int:
    """Return a chart's height [px]."""
    legend = 17 * -(-len(panel.lines) // count_columns(panel)) if needs_legend_below(panel) else 0
    return legend + (74 + 25 * max(len(panel.categories), 3) if panel.categories else HEIGHT_PX)


def draw_line(axes: Axes, line: Line, color: str, joined: bool) -> None:
    """Draw one line over numbers."""
    if len(line.x) > NOISY and joined and not is_step(line):
        axes.plot(line.x, line.y, color=color, linewidth=0.7, alpha=0.3)
        axes.plot(line.x, smooth(line.y), color=color, linewidth=1.7, label=line.label)
        return
    if len(line.low):
        axes.fill_between(line.x, line.low, line.high, color=color, alpha=0.16, linewidth=0)
    few = len(line.x) <= 20
    style = ("o-" if few else "-") if joined else "o"
    marks: dict[str, Any] = {"markersize": 4.5}
    if not joined and not few:
        marks = {"markersize": 3, "alpha": 0.5}
    axes.plot(line.x, line.y, style, color=color, linewidth=1.7, label=line.label, **marks)
    if line.dots:
        x, y = zip(*line.dots, strict=True)
        axes.plot(x, y, "o", color=color, alpha=0.45, markersize=3.5, linewidth=0)


def is_step(line: Line) -> bool:
    """Tell whether a line goes by steps, as a distribution does: it is no noise to be smoothed."""
    return bool(np.any(np.diff(np.asarray(line.x, float)) == 0))


def draw_across(axes: Axes, line: Line, color: str) -> None:
    """Draw values to the right of named rows: range, single runs, mean."""
    if len(line.low):
        axes.hlines(line.x, line.low, line.high, color=color, linewidth=5, alpha=0.25)
    if line.dots:
        rows, values = zip(*line.dots, strict=True)
        axes.plot(values, rows, "o", color=color, alpha=0.45, markersize=3.5)
    axes.plot(line.y, line.x, "o", color=color, markersize=6.5, label=line.label)


def style_axes(axes: Axes, panel: Panel, theme: Theme) -> None:
    """Give a chart its title, axes, legend and colors."""
    axes.set_facecolor(theme.paper)
    title = f"{panel.title} [{panel.unit}]" if panel.unit else panel.title
    axes.set_title(title, fontsize=10, color=theme.ink, loc="left", fontweight="bold")
    for which in ("major", "minor"):  # of log axes, the latter have labels too
        axes.tick_params(which=which, colors=theme.soft, labelcolor=theme.ink, labelsize=8.5)
    axes.tick_params(length=3)
    axes.grid(color=theme.soft, alpha=0.25, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(theme.soft)
    if panel.categories:
        names = [escape(name) for name in distinguish(panel.categories)]
        axes.set_yticks(range(len(names)), names)
        axes.set_ylim(len(panel.categories) - 0.5, -0.5)
        if panel.limits:
            axes.set_xlim(*panel.limits)
    else:
        axes.set_xlabel(panel.xlabel, fontsize=8.5, color=theme.ink)
        if panel.log_x:
            axes.set_xscale("log")
            write_plainly(axes.xaxis)
        if panel.log_y:
            axes.set_yscale("log")
            write_plainly(axes.yaxis)
        ticks = sorted(set(panel.ticks))
        if 0 < len(ticks) <= MOST_TICKS:
            axes.set_xticks(ticks, [f"{x:g}" for x in ticks])
            axes.xaxis.set_minor_locator(NullLocator())
        elif not panel.log_x:
            whole = all(float(x).is_integer() for line in panel.lines for x in line.x)
            axes.xaxis.set_major_locator(MaxNLocator(6, integer=whole))
        if panel.limits:
            axes.set_ylim(*panel.limits)
        if panel.diagonal:
            axes.plot(panel.diagonal, panel.diagonal, "-", color=theme.soft, linewidth=1, zorder=1)


class PlainNumbers(LogFormatter):
    """Numbers of a logarithmic axis as they are, `30` and not `3e1`; minor ones where few powers of
    ten are on the axis.
    """

    def __call__(self, x: float, pos: int | None = None) -> str:
        """Return a tick's label, empty where it has none."""
        return f"{x:g}" if super().__call__(x, pos) else ""


def write_plainly(axis: Axis) -> None:
    """Have the ticks of a logarithmic axis be plain numbers."""
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(PlainNumbers())


def smooth(values: Sequence[float]) -> np.ndarray:
    """Return a running mean over about a twelfth of a line; what is not finite does not count.

    Narrower at the start, where losses fall steeply; at the end one-sided, since a narrow mean
    would show a last jump as a trend.
    """
    y = np.asarray(values, float)
    reach = max(1, len(y) // 24)
    known = np.isfinite(y)
    total = np.concatenate([[0.0], np.cumsum(np.where(known, y, 0))])
    count = np.concatenate([[0], np.cumsum(known)])
    at = np.arange(len(y))
    back = np.minimum(reach, at)
    low, high = at - back, at + np.minimum(back, len(y) - 1 - at) + 1
    n = count[high] - count[low]
    return np.where(n > 0, (total[high] - total[low]) / np.maximum(n, 1), math.nan)


def distinguish(names: Sequence[str], max_length: int = 22) -> list[str]:
    """Return names short enough for a chart, without what long ones have in common."""
    if all(len(name) <= max_length for name in names):
        return list(names)
    if len(set(names)) > 1:
        first = _count_common(names)
        last = _count_common([name[first:][::-1] for name in names])
        # whole words: what is left out ends where one does
        first = max((names[0].rfind(end, 0, first) + 1 for end in _ENDS), default=0)
        tail = names[0][len(names[0]) - last :]
        last -= min((at for end in _ENDS if (at := tail.find(end)) >= 0), default=last)
        start, end = "…" if first else "", "…" if last else ""
        names = [start + name[first : len(name) - last] + end for name in names]
    return [shorten(name, max_length) for name in names]


def _count_common(names: Sequence[str]) -> int:
    """Return by how many characters all names begin alike."""
    columns = zip(*names, strict=False)
    return sum(1 for _ in takewhile(lambda column: len(set(column)) == 1, columns))


def escape(text: str) -> str:
    """Return a text that Matplotlib writes as it is: a dollar sign begins no formula, and a line
    down at the start hides no entry of a legend.
    """
    text = text.replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text


def shorten(text: str, max_length: int = 22) -> str:
    """Return a text of at most `max_length` characters: by default, a name that fits beside a
    chart.
    """
    return text if len(text) <= max_length else text[: max_length - 1] + "…"


def to_small_png(figure: Figure) -> bytes:
    """Return a figure as a PNG of 128 colors, a third of the plain one."""
    stream = BytesIO()
    small = Image.fromarray(rasterize(figure)).quantize(128, dither=Image.Dither.NONE)
    small.save(stream, "PNG", optimize=True)
    return stream.getvalue()
