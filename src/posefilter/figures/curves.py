"""Draw numbers that change over the filter's iterations."""

from collections.abc import Mapping, Sequence

import numpy as np

from posefilter.figures.canvas import Color, arrange_grid
from posefilter.figures.layout import (
    DETAIL,
    WIDTH,
    add_caption,
    compose_figure,
    draw_legend,
    draw_text,
    tile_width,
)
from posefilter.figures.panels import Axis, draw_curve_panel
from posefilter.metrics.registry import HIGHER, PERCENT, MetricInfo, find_metric

_LINE: Color = (43, 108, 176)
_HEIGHT = 190  # [px] of a panel


def draw_health(
    curves: Mapping[str, Sequence[float]], images: int, title: str = "Filter health"
) -> np.ndarray:
    """Draw how the filter fares over its iterations, one panel a quantity.

    Args:
        curves: One number an iteration by name (`ess`, `spread_m`, ...), as stored.
        images: How many images these are the means of.
        title: Of the figure.

    Returns:
        A figure (H, WIDTH, 3) uint8.
    """
    panels = []
    width = tile_width(2)
    for name, values in curves.items():
        info = find_metric(f"filter/{name}")
        numbers = info.factor * np.asarray(values, float)
        low, high = choose_bounds(info, numbers)
        y = Axis(info.unit, low, high, choose_ticks(low, high))
        x = make_iteration_axis(len(numbers))
        places = np.arange(len(numbers), dtype=float)
        panel = draw_curve_panel([(numbers, _LINE)], places, x, y, width, _HEIGHT, thick=3)
        panels.append(add_caption(panel, info.short or info.label))
    note = draw_text(f"means over {images} image{'s' * (images != 1)}", DETAIL)
    return compose_figure(title, note, arrange_grid(panels, 2))


def draw_shares(
    curves: Mapping[str, tuple[Sequence[float], Color]], title: str, foot: str
) -> np.ndarray:
    """Draw shares of the particles, or of their variance, over the iterations, in percent, in one
    panel.  curves: numbers in [0, 1], a color.
    """
    count = max(len(values) for values, _ in curves.values())
    lines = [(100 * np.asarray(values, float), color) for values, color in curves.values()]
    y = Axis("share of particles or variance [%]", -2, 102, (0, 25, 50, 75, 100))
    panel = draw_curve_panel(
        lines, np.arange(count, dtype=float), make_iteration_axis(count), y, WIDTH, 380, thick=4
    )
    entries = [(name.replace("_", " "), color) for name, (_, color) in curves.items()]
    return compose_figure(title, panel, draw_legend(entries), draw_text(foot, DETAIL))


def make_iteration_axis(count: int) -> Axis:
    """Return the axis of `count` iterations, marked in whole numbers."""
    step = max(1, -(-(count - 1) // 6))
    return Axis("iteration", -0.3, max(count - 0.7, 0.7), tuple(range(0, count, step)))


def choose_bounds(info: MetricInfo, values: np.ndarray) -> tuple[float, float]:
    """Return where a panel ends: shares at 0 and 100, sizes at 0, the rest a little beyond its
    numbers.
    """
    if info.limits == PERCENT:
        return 0.0, 100.0
    good = values[np.isfinite(values)]
    if not len(good):
        return 0.0, 1.0
    low, high = float(good.min()), float(good.max())
    if low >= 0 and info.direction != HIGHER:
        return 0.0, max(high * 1.08, 1e-9)
    pad = max(0.08 * (high - low), 1e-6)
    return low - pad, high + pad


def choose_ticks(
    low: float, high: float, max_ticks: int = 4, min_ticks: int = 3
) -> tuple[float, ...]:
    """Return round numbers, evenly spaced, within bounds."""
    ticks: tuple[float, ...] = ()
    # closer ones where few would fall within the bounds
    for count in range(max_ticks, 2 * max_ticks + 1):
        rough = (high - low) / count
        power = 10.0 ** np.floor(np.log10(rough))
        step = next(m * power for m in (1, 2, 2.5, 5, 10) if m * power >= rough * (1 - 1e-9))
        first, last = int(np.ceil(low / step)), int(np.floor(high / step))
        ticks = tuple(float(round(i * step, 12)) for i in range(first, last + 1))
        if len(ticks) >= min_ticks:
            break
    return ticks
