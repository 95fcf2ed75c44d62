"""Small plots with a frame, ticks and labels, drawn straight onto pixels: a hundred times sooner than a plotting library.

A panel's place for the plot is `size` pixels square; round it are margins for the title, the ticks and the labels.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from matplotlib import colormaps
from PIL import Image, ImageDraw

from posefilter.pictures.canvas import INK, PAPER, Colour, draw_dots, draw_lines, font

LEFT, TOP, RIGHT, BOTTOM = 58, 28, 18, 44  # margins [px]
SURFACE: Colour = (110, 114, 120)
_GRID: Colour = (225, 228, 232)
_LETTERS = 13


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
    colour: Colour
    shape: str = "ring"  # or "square"


def colours(values: np.ndarray, low: float, high: float, name: str = "viridis") -> np.ndarray:
    """Return numbers as colours, what lies beyond the ends as these.  (*) -> (*, 3) uint8."""
    share = np.clip((values - low) / max(high - low, 1e-12), 0, 1)
    painted = np.asarray(colormaps[name](np.nan_to_num(share)))[..., :3]
    return (painted * 255).round().astype(np.uint8)


def heat_panel(
    cells: np.ndarray, x: Axis, y: Axis, title: str, size: int, marks: Sequence[Mark] = (), dots: np.ndarray | None = None
) -> np.ndarray:
    """Draw a grid of colours (G, G, 3) uint8, row i at the i-th of even values of y from `low` to `high`, upwards.

    The cells' centres run from end to end of the axes, and smoothing lies between them. dots: (P, 2) places that are
    pricked in. -> picture.
    """
    plot = cv2.resize(cells[::-1], (size, size), interpolation=cv2.INTER_NEAREST)
    if dots is not None and len(dots):
        draw_dots(plot, _at(dots, x, y, size), np.tile(np.array([SURFACE]), (len(dots), 1)), 1.2)
    for mark in marks:
        _point(plot, mark, x, y, size)
    return framed(plot, x, y, title)


def curve_panel(
    lines: Sequence[tuple[np.ndarray, Colour]], places: np.ndarray, x: Axis, y: Axis, title: str, width: int, height: int
) -> np.ndarray:
    """Draw curves (P,) each over the same places (P,); what lies beyond the axes is cut at their ends."""
    plot = np.full((height, width, 3), PAPER, np.uint8)
    for value in y.ticks:
        v = round((y.high - value) / (y.high - y.low) * (height - 1))
        plot[v] = _GRID
    for value in x.ticks:
        plot[:, round((value - x.low) / (x.high - x.low) * (width - 1))] = _GRID
    for values, colour in lines:
        u = (places - x.low) / (x.high - x.low) * (width - 1)
        v = (y.high - np.clip(values, y.low, y.high)) / (y.high - y.low) * (height - 1)
        draw_lines(plot, [np.stack([u, v], 1)], colour, 2, halo=False)
    return framed(plot, x, y, title)


def framed(plot: np.ndarray, x: Axis, y: Axis, title: str) -> np.ndarray:
    """Put title, ticks and labels round a plot."""
    height, width = plot.shape[:2]
    sheet = np.full((height + TOP + BOTTOM, width + LEFT + RIGHT, 3), PAPER, np.uint8)
    sheet[TOP : TOP + height, LEFT : LEFT + width] = plot
    image = Image.fromarray(sheet)
    pen, letters = ImageDraw.Draw(image), font(_LETTERS)
    pen.rectangle([LEFT - 1, TOP - 1, LEFT + width, TOP + height], outline=INK)
    pen.text((LEFT + width / 2, TOP / 2), title, fill=INK, font=font(_LETTERS + 1), anchor="mm")
    for value in x.ticks:
        u = LEFT + (value - x.low) / (x.high - x.low) * (width - 1)
        pen.line([(u, TOP + height), (u, TOP + height + 4)], fill=INK)
        pen.text((u, TOP + height + 6), f"{value:g}", fill=INK, font=letters, anchor="mt")
    for value in y.ticks:
        v = TOP + (y.high - value) / (y.high - y.low) * (height - 1)
        pen.line([(LEFT - 5, v), (LEFT - 1, v)], fill=INK)
        pen.text((LEFT - 7, v), f"{value:g}", fill=INK, font=letters, anchor="rm")
    pen.text((LEFT + width / 2, TOP + height + 24), x.label, fill=INK, font=letters, anchor="mt")
    side = Image.new("RGB", (height, 20), PAPER)
    ImageDraw.Draw(side).text((height / 2, 10), y.label, fill=INK, font=letters, anchor="mm")
    image.paste(side.rotate(90, expand=True), (0, TOP))
    return np.asarray(image)


def upright_bar(low: str, high: str, title: str, size: int, name: str = "viridis", width: int = 84) -> np.ndarray:
    """Return a colour scale as high as a panel of `size`, its ends named."""
    sheet = np.full((size + TOP + BOTTOM, width, 3), PAPER, np.uint8)
    ramp = colours(np.linspace(1, 0, size), 0, 1, name)
    sheet[TOP : TOP + size, 6:24] = ramp[:, None]
    image = Image.fromarray(sheet)
    pen, letters = ImageDraw.Draw(image), font(_LETTERS)
    pen.rectangle([5, TOP - 1, 24, TOP + size], outline=INK)
    pen.text((4, TOP / 2), title, fill=INK, font=letters, anchor="lm")
    pen.text((29, TOP + 7), high, fill=INK, font=letters, anchor="lm")
    pen.text((29, TOP + size - 8), low, fill=INK, font=letters, anchor="lm")
    return np.asarray(image)


def flat_bar(label: str, low: str, high: str, name: str, size: int = 15, long: int = 160) -> np.ndarray:
    """Return a colour scale that lies in a strip of writing: label, low end, colours, high end."""
    letters = font(size)
    before, after = f"{label}   {low}", high
    left = 8 + letters.getlength(before) + 8
    line = round(size * 1.9)
    image = Image.new("RGB", (round(left + long + 8 + letters.getlength(after) + 18), line), PAPER)
    pen = ImageDraw.Draw(image)
    pen.text((8, line / 2), before, fill=INK, font=letters, anchor="lm")
    pen.text((left + long + 8, line / 2), after, fill=INK, font=letters, anchor="lm")
    out = np.asarray(image).copy()
    out[6:-6, round(left) : round(left) + long] = colours(np.linspace(0, 1, long), 0, 1, name)[None]
    return out


def beside(parts: Sequence[np.ndarray], width: int | None = None) -> np.ndarray:
    """Put pictures side by side, on white where one is lower; `width` pads or cuts the whole."""
    height = max(part.shape[0] for part in parts)
    padded = [np.pad(p, ((0, height - p.shape[0]), (0, 0), (0, 0)), constant_values=255) for p in parts]
    row = np.concatenate(padded, axis=1)
    if width is None:
        return row
    return np.pad(row[:, :width], ((0, 0), (0, max(0, width - row.shape[1])), (0, 0)), constant_values=255)


def _at(places: np.ndarray, x: Axis, y: Axis, size: int) -> np.ndarray:
    u = (places[:, 0] - x.low) / (x.high - x.low)
    v = (y.high - places[:, 1]) / (y.high - y.low)
    return np.stack([u, v], 1) * (size - 1)


def _point(plot: np.ndarray, mark: Mark, x: Axis, y: Axis, size: int) -> None:
    """Draw a ring or a square, in place; on the rim where it lies beyond."""
    reach = 9 if mark.shape == "ring" else 6
    at = np.clip(_at(np.array([[mark.x, mark.y]]), x, y, size), reach, size - 1 - reach)[0]
    turn = np.linspace(0, 2 * np.pi, 25)[:-1] if mark.shape == "ring" else np.pi / 4 + np.arange(4) * np.pi / 2
    length = reach if mark.shape == "ring" else reach * 2**0.5
    draw_lines(plot, [at + length * np.stack([np.cos(turn), np.sin(turn)], 1)], mark.colour, 2, closed=True)
