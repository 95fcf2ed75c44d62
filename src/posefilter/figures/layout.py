"""Figures that are read in small: one width for all, and one scale of letters.

TensorBoard's cards show a figure at half its width, and take every second pixel rather than the
mean of two: there a title and a legend are read, captions nearly so; detail is for the whole size.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from posefilter.figures.canvas import INK, PAPER, Color, load_font

WIDTH = 600  # [px] of every figure
THUMBNAIL = 300  # [px] as wide as TensorBoard's cards show it
# [px] sizes of letters; a small x is 0.55 of it high
TITLE, LEGEND, CAPTION, DETAIL = 36, 27, 24, 15
GAP = 6  # [px] between tiles, and round them
_LEADING = 1.25  # a line is so much higher than its letters' size
_SWATCH = 26  # [px] the line of color before a legend's word


def tile_width(columns: int) -> int:
    """Return how wide tiles are [px], of which `arrange_grid` needs so many to fill a figure."""
    return (WIDTH - GAP) // columns - GAP


def compose_figure(title: str, *parts: np.ndarray) -> np.ndarray:
    """Put parts below each other, each in the middle of the figure, under a title.  -> (h, WIDTH,
    3) uint8.

    title: its first line is the title, in bold; what follows is said below it.
    """
    head, *rest = title.split("\n")
    lines = [draw_text(head, TITLE, bold=True), *(draw_text(line, CAPTION) for line in rest)]
    return np.concatenate([*lines, *(center_part(part) for part in parts)])


def center_part(part: np.ndarray) -> np.ndarray:
    """Return a picture with white at both sides, as wide as a figure.  Raises ValueError where it
    is wider than that.
    """
    spare = WIDTH - part.shape[1]
    if spare < 0:
        raise ValueError(f"a part of {part.shape[1]} pixels does not fit a figure of {WIDTH}")
    return np.pad(part, ((0, 0), (spare // 2, spare - spare // 2), (0, 0)), constant_values=255)


@lru_cache(maxsize=256)  # most of it is written again after each validation
def draw_text(text: str, size: int, width: int = WIDTH, bold: bool = False) -> np.ndarray:
    """Return writing on white, in as many lines as it needs.  -> (h, width, 3) uint8."""
    letters = load_font(size, bold)
    line = round(size * _LEADING)
    lines = wrap_text(text, letters, width - 2 * GAP)
    image = Image.new("RGB", (width, line * len(lines)), PAPER)
    pen = ImageDraw.Draw(image)
    for number, words in enumerate(lines):
        pen.text((GAP, line * (number + 0.5)), words, fill=INK, font=letters, anchor="lm")
    return np.asarray(image)


def wrap_text(text: str, letters: ImageFont.FreeTypeFont, width: float) -> list[str]:
    """Return a text's lines, none wider than `width` unless it is one word."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and letters.getlength(longer) > width:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


def cut_text(text: str, size: int, width: int) -> str:
    """Return the end of a name, as much of it as fits on one line: what tells frames apart stands
    at their names' end.
    """
    letters = load_font(size)
    for start in range(len(text)):
        cut = text if start == 0 else "…" + text[start:]
        if letters.getlength(cut) <= width - 2 * GAP:
            return cut
    return ""


def format_length(length: float) -> str:
    """Return a length [m] in words: in millimeters, or in meters where these get long."""
    if length < 0.9995:
        return f"{1000 * length:.3g} mm"
    if math.isinf(length):
        return "missed"
    return f"{length:.2f} m" if length < 100 else f"{length:.0f} m"


def draw_legend(
    entries: Sequence[tuple[str, Color]], width: int = WIDTH, size: int = LEGEND
) -> np.ndarray:
    """Return what colors mean, each a stroke of the color before its word, in as many lines as that
    needs.  -> picture.
    """
    letters = load_font(size)
    line, stroke = round(size * _LEADING), max(4, size // 4)
    places, left, row = [], GAP, 0
    for word, _ in entries:
        long = round(_SWATCH + 8 + letters.getlength(word))
        if left > GAP and left + long > width - GAP:
            left, row = GAP, row + 1
        places.append((left, row))
        left += long + 16
    image = Image.new("RGB", (width, line * (row + 1)), PAPER)
    pen = ImageDraw.Draw(image)
    for (word, color), (left, row) in zip(entries, places, strict=True):
        middle = line * (row + 0.5)
        pen.line([(left, middle), (left + _SWATCH, middle)], fill=color, width=stroke)
        pen.text((left + _SWATCH + 8, middle), word, fill=INK, font=letters, anchor="lm")
    return np.asarray(image)


def draw_scale(
    before: str, ramp: np.ndarray, after: str, width: int = WIDTH, size: int = LEGEND
) -> np.ndarray:
    """Return a scale of colors: what it starts from, the colors (n, 3) uint8, what it ends at.  ->
    picture.
    """
    letters = load_font(size)
    line = round(size * _LEADING)
    left = round(GAP + letters.getlength(before) + 10)
    right = round(width - GAP - letters.getlength(after) - 10)
    image = Image.new("RGB", (width, line), PAPER)
    pen = ImageDraw.Draw(image)
    pen.text((GAP, line / 2), before, fill=INK, font=letters, anchor="lm")
    pen.text((right + 10, line / 2), after, fill=INK, font=letters, anchor="lm")
    out = np.asarray(image).copy()
    if right > left:
        out[size // 4 : -size // 4, left:right] = ramp[
            np.linspace(0, len(ramp) - 1, right - left).round().astype(int)
        ]
    return out


def add_caption(
    tile: np.ndarray, caption: str, size: int = CAPTION, note: str | None = None
) -> np.ndarray:
    """Put a caption above a tile, and a note in small letters below the caption."""
    width = tile.shape[1]
    notes = [draw_text(note, DETAIL, width)] if note is not None else []
    return np.concatenate([draw_text(caption, size, width), *notes, tile])
