"""Small plots with a frame, ticks and labels, drawn straight onto pixels: a hundred times sooner
than a plotting library.

Round a panel's plot are margins for the ticks and the labels; what it shows is said above it
(`add_caption`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from matplotlib import colormaps
from PIL import Image, ImageDraw

from posefilter.figures.canvas import INK, PAPER, Color, draw_dots, draw_lines, load_font
from posefilter.figures.layout import DETAIL, LEGEND, WIDTH, draw_scale

LEFT, TOP, RIGHT, BOTTOM = 74, 8, 14, 48  # margins [px]
SURFACE: Color = (110, 114, 120)
_GRID: Color = (225, 228, 232)
_MASS: Color = (122, 153, 196)
_REACH = 9  # [px] of a ring


class Axis(NamedTuple):
    """What a direction of a panel means."""

    label: str
    low: float
    high: float
    ticks: Sequence[float]


class Mark(NamedTuple):
    """A place to point at."""

    x: float
    y: float
    color: Color
    shape: str = "ring"  # or "square", "diamond"


def map_colors(values: np.ndarray, low: float, high: float, name: str = "viridis") -> np.ndarray:
    """Return numbers as colors, what lies beyond the ends as these.  (*) -> (*, 3) uint8."""
    share = np.clip((values - low) / max(high - low, 1e-12), 0, 1)
    painted = np.asarray(colormaps[name](np.nan_to_num(share)))[..., :3]
    return (painted * 255).round().astype(np.uint8)


def draw_heat_panel(
    cells: np.ndarray,
    x: Axis,
    y: Axis,
    width: int,
    marks: Sequence[Mark] = (),
    dots: np.ndarray | None = None,
) -> np.ndarray:
    """Draw a grid of colors (G, G, 3) uint8, row i at the i-th of even values of y from `low` to
    `high`, upwards.

    The cells' centers run from end to end of the axes, and smoothing lies between them. dots: (P,
    2) places that are pricked in. -> picture, its square plot as large as `width` allows.
    """
    size = width - LEFT - RIGHT
    plot = cv2.resize(cells[::-1], (size, size), interpolation=cv2.INTER_NEAREST)
    if dots is not None and len(dots):
        draw_dots(plot, _locate(dots, x, y, plot), SURFACE, 1.2)
    for mark in marks:
        at = _locate(np.array([[mark.x, mark.y]]), x, y, plot)[0]
        draw_mark(plot, np.clip(at, _REACH, size - 1 - _REACH), mark.color, mark.shape)
    return add_frame(plot, x, y)


def draw_curve_panel(
    lines: Sequence[tuple[np.ndarray, Color]],
    places: np.ndarray,
    x: Axis,
    y: Axis,
    width: int,
    height: int,
    thick: int = 2,
) -> np.ndarray:
    """Draw curves (P,) each over the same places (P,); what lies beyond the axes is cut at their
    ends.

    width, height: of the whole panel [px].
    """
    plot = _draw_rules(x, y, width, height)
    for values, color in lines:
        path = _locate(np.stack([places, np.clip(values, y.low, y.high)], 1), x, y, plot)
        if len(path) == 1:  # a line of one point would not be seen
            path = path + np.array([[-thick, 0.0], [thick, 0.0]])
        draw_lines(plot, [path], color, thick, halo=False)
    return add_frame(plot, x, y)


def draw_histogram_panel(
    mass: np.ndarray,
    edges: np.ndarray,
    marks: Sequence[tuple[float, Color]],
    x: Axis,
    y: Axis,
    width: int,
    height: int,
) -> np.ndarray:
    """Draw a histogram (M,) between edges (M + 1,), and upright lines; width, height: of the whole
    panel [px].
    """
    plot = _draw_rules(x, y, width, height)
    corners = _locate(np.stack([edges, np.append(mass, 0)], 1), x, y, plot).round().astype(int)
    for share, (left, top), right in zip(
        mass, corners[:-1].tolist(), corners[1:, 0].tolist(), strict=True
    ):
        if share > 0:
            plot[max(top, 0) :, left : max(right, left + 1)] = _MASS
    for value, color in marks:
        (u, _), (_, low) = _locate(np.array([[value, y.high], [value, y.low]]), x, y, plot)
        draw_lines(plot, [np.array([[u, 0], [u, low]])], color, 2)
    return add_frame(plot, x, y)


def _draw_rules(x: Axis, y: Axis, width: int, height: int) -> np.ndarray:
    """Return an empty plot with lines at its ticks."""
    width, height = width - LEFT - RIGHT, height - TOP - BOTTOM
    plot = np.full((height, width, 3), PAPER, np.uint8)
    for value in y.ticks:
        plot[round((y.high - value) / (y.high - y.low) * (height - 1))] = _GRID
    for value in x.ticks:
        plot[:, round((value - x.low) / (x.high - x.low) * (width - 1))] = _GRID
    return plot


def add_frame(plot: np.ndarray, x: Axis, y: Axis) -> np.ndarray:
    """Put ticks and labels round a plot."""
    height, width = plot.shape[:2]
    figure = np.full((height + TOP + BOTTOM, width + LEFT + RIGHT, 3), PAPER, np.uint8)
    figure[TOP : TOP + height, LEFT : LEFT + width] = plot
    image = Image.fromarray(figure)
    pen, letters = ImageDraw.Draw(image), load_font(DETAIL)
    pen.rectangle([LEFT - 1, TOP - 1, LEFT + width, TOP + height], outline=INK)
    for value in x.ticks:
        u = LEFT + (value - x.low) / (x.high - x.low) * (width - 1)
        pen.line([(u, TOP + height), (u, TOP + height + 4)], fill=INK)
        pen.text((u, TOP + height + 6), f"{value:g}", fill=INK, font=letters, anchor="mt")
    for value in y.ticks:
        v = TOP + (y.high - value) / (y.high - y.low) * (height - 1)
        pen.line([(LEFT - 5, v), (LEFT - 1, v)], fill=INK)
        pen.text((LEFT - 7, v), f"{value:g}", fill=INK, font=letters, anchor="rm")
    pen.text((LEFT + width / 2, TOP + height + 25), x.label, fill=INK, font=letters, anchor="mt")
    if y.label:
        side = Image.new("RGB", (figure.shape[0], 20), PAPER)  # a label may be longer than its axis
        at = min(BOTTOM + height / 2, figure.shape[0] - letters.getlength(y.label) / 2)
        ImageDraw.Draw(side).text((at, 10), y.label, fill=INK, font=letters, anchor="mm")
        image.paste(side.rotate(90, expand=True), (0, 0))
    return np.asarray(image)


def draw_color_scale(
    before: str, after: str, name: str = "viridis", width: int = WIDTH, size: int = LEGEND
) -> np.ndarray:
    """Return a scale of a map's colors between what its ends mean."""
    return draw_scale(before, map_colors(np.linspace(0, 1, 256), 0, 1, name), after, width, size)


def arrange_row(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Put pictures side by side, on white where one is lower."""
    height = max(part.shape[0] for part in parts)
    padded = [
        np.pad(p, ((0, height - p.shape[0]), (0, 0), (0, 0)), constant_values=255) for p in parts
    ]
    return np.concatenate(padded, axis=1)


def draw_mark(
    picture: np.ndarray,
    at: np.ndarray,
    color: Color,
    shape: str = "ring",
    size: float = 0,
    width: int = 2,
) -> None:
    """Draw a ring, square or diamond round a place (2,) [px], in place; size: how far it goes (0:
    as in panels).
    """
    size = size or (_REACH if shape == "ring" else 2 * _REACH / 3)
    first = np.pi / 4 if shape == "square" else 0.0
    turn = first + np.arange(4) * np.pi / 2
    if shape == "ring":
        turn = np.linspace(0, 2 * np.pi, 33)[:-1]
    length = size * 2**0.5 if shape == "square" else size
    corners = at + length * np.stack([np.cos(turn), np.sin(turn)], 1)
    draw_lines(picture, [corners], color, width, closed=True)


def _locate(places: np.ndarray, x: Axis, y: Axis, plot: np.ndarray) -> np.ndarray:
    """Return where places (P, 2) lie on a plot.  -> (P, 2) [px]."""
    u = (places[:, 0] - x.low) / (x.high - x.low)
    v = (y.high - places[:, 1]) / (y.high - y.low)
    return np.stack([u, v], 1) * [plot.shape[1] - 1, plot.shape[0] - 1]
