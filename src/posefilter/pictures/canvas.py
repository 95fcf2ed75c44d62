"""What every picture shares: colours, lines that show on any ground, lettering, strips and grids of tiles.

Pictures are (H, W, 3) uint8 RGB. Places are pixels (u, v) whose centres have integer coordinates.
"""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

Colour = tuple[int, int, int]
ESTIMATE: Colour = (255, 80, 200)  # neither is a colour that photographs of cartons and tables are full of
TRUTH: Colour = (70, 235, 120)
AXES: tuple[Colour, Colour, Colour] = ((235, 60, 50), (60, 190, 70), (70, 130, 255))  # x, y, z
INK: Colour = (32, 36, 44)
PAPER: Colour = (255, 255, 255)
_HALO: Colour = (0, 0, 0)
_SHIFT = 4  # OpenCV draws in sixteenths of a pixel
_FARTHEST = 16_000  # [px] OpenCV's sixteenths overflow beyond


def to_picture(rgb: Tensor) -> np.ndarray:
    """Return an image tensor (3, H, W) in [0, 1] as a picture."""
    return (rgb.detach().cpu().clamp(0, 1).permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)


def enlarge(rgb: np.ndarray, factor: int) -> np.ndarray:
    """Enlarge a picture by a whole factor, smoothly."""
    if factor == 1:
        return np.ascontiguousarray(rgb)
    return np.asarray(cv2.resize(rgb, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC))


def enlarge_intrinsics(K: np.ndarray, factor: int) -> np.ndarray:
    """Return the camera matrix of the enlarged picture, pixel centres at integers.  (3, 3) [px]."""
    out = np.array(K, np.float64)
    out[:2] *= factor
    out[:2, 2] += (factor - 1) / 2
    return out


def enlarge_pixels(pixels: np.ndarray, factor: int) -> np.ndarray:
    """Return where places are in the enlarged picture.  (*, 2) [px] -> (*, 2) [px]."""
    return np.asarray(pixels, np.float64) * factor + (factor - 1) / 2


def factor_for(width: int, wanted: int) -> int:
    """Return the whole factor that makes a picture at least `wanted` wide."""
    return max(1, -(-wanted // width))


def draw_lines(picture: np.ndarray, paths: Sequence[np.ndarray], colour: Colour, width: int, closed: bool = False) -> None:
    """Draw anti-aliased lines, with a dark halo so that they show on any ground.  paths: each (P, 2) [px]."""
    fixed = [np.round(np.clip(path, -_FARTHEST, _FARTHEST) * 2**_SHIFT).astype(np.int32) for path in paths if len(path) > 1]
    if not fixed:
        return
    cv2.polylines(picture, fixed, closed, _HALO, width + 2, cv2.LINE_AA, _SHIFT)
    cv2.polylines(picture, fixed, closed, colour, width, cv2.LINE_AA, _SHIFT)


def draw_dots(picture: np.ndarray, pixels: np.ndarray, colours: np.ndarray, radius: float) -> None:
    """Draw anti-aliased discs, later ones on top.  (P, 2) [px], (P, 3) uint8."""
    at = np.round(np.clip(pixels, -_FARTHEST, _FARTHEST) * 2**_SHIFT).astype(int)
    size = round(radius * 2**_SHIFT)
    for (u, v), colour in zip(at.tolist(), colours.tolist(), strict=True):
        cv2.circle(picture, (u, v), size, colour, -1, cv2.LINE_AA, _SHIFT)


@cache
def font(size: int) -> ImageFont.FreeTypeFont:
    """Return the lettering that comes with matplotlib."""
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size)


def strip(width: int, text: str, entries: Sequence[tuple[str, Colour]] = (), size: int = 15) -> np.ndarray:
    """Return a strip of writing: text at the left, a legend of coloured lines at the right.  -> (h, width, 3) uint8.

    Writing that does not fit beside the legend goes on a line of its own.
    """
    letters = font(size)
    legend = sum(28 + letters.getlength(label) + 16 for label, _ in entries)
    rows = 2 if text and entries and letters.getlength(text) + 24 + legend > width else 1
    line = round(size * 1.9)
    sheet = Image.new("RGB", (width, line * rows), PAPER)
    pen = ImageDraw.Draw(sheet)
    pen.text((8, line / 2), text, fill=INK, font=letters, anchor="lm")
    left, middle = (width - legend if rows == 1 and text else 8.0), line * (rows - 0.5)
    for label, colour in entries:
        pen.line([(left, middle), (left + 22, middle)], fill=colour, width=4)
        pen.text((left + 28, middle), label, fill=INK, font=letters, anchor="lm")
        left += 28 + letters.getlength(label) + 16
    return np.asarray(sheet)


def grid(tiles: Sequence[np.ndarray], columns: int, gap: int = 6) -> np.ndarray:
    """Lay tiles out in rows, each cell as large as the largest tile.  -> picture."""
    height, width = max(t.shape[0] for t in tiles), max(t.shape[1] for t in tiles)
    columns = min(columns, len(tiles))
    rows = -(-len(tiles) // columns)
    sheet = np.full((rows * (height + gap) + gap, columns * (width + gap) + gap, 3), 255, np.uint8)
    for i, tile in enumerate(tiles):
        top, left = gap + i // columns * (height + gap), gap + i % columns * (width + gap)
        sheet[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
    return sheet


def new_figure(width_px: int, height_px: int, dpi: int = 100) -> Figure:
    """Return an empty figure that draws itself with Agg, without matplotlib's global state."""
    figure = Figure(figsize=(width_px / dpi, height_px / dpi), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def rasterise(figure: Figure) -> np.ndarray:
    """Return a figure as a picture."""
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def save_picture(picture: np.ndarray, path: Path) -> None:
    """Write a picture as PNG, its folder made where it is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path)
