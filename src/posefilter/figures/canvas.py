"""What every picture shares: colors, lines that show on any ground, lettering, rows and grids of
tiles.

Pictures are (H, W, 3) uint8 RGB. Places are pixels (u, v) whose centers have integer coordinates.
"""

from collections.abc import Sequence
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import cv2
import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from posefilter.files import write_whole
from posefilter.images import to_picture

Color = tuple[int, int, int]
# neither is a color that photographs of cartons and tables are full of
ESTIMATE: Color = (255, 80, 200)
TRUTH: Color = (70, 235, 120)
AXES: tuple[Color, Color, Color] = ((235, 60, 50), (60, 190, 70), (70, 130, 255))  # x, y, z
INK: Color = (32, 36, 44)
PAPER: Color = (255, 255, 255)
_HALO: Color = (0, 0, 0)
_BEYOND = (200, 200, 200)
_SHIFT = 4  # OpenCV draws in sixteenths of a pixel
_TAG = 14  # [px] letters of a tag
_FARTHEST = 16_000  # [px] OpenCV's sixteenths overflow beyond


def to_image(rgb: Tensor) -> np.ndarray:
    """Return an image tensor (3, H, W) in [0, 1] as a picture."""
    return (rgb.detach().cpu().clamp(0, 1).permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)


class View(NamedTuple):
    """A part of a photograph, shown at some size."""

    left: float  # edges in the photograph [px]; its own are -0.5
    top: float
    scale: float  # shown pixels for one of the photograph's
    width: int  # of what is shown [px]
    height: int

    def show(self, rgb: np.ndarray) -> np.ndarray:
        """Return what is seen, gray beyond the photograph's edges.

        (H, W, 3) uint8 -> (height, width, 3) uint8.
        """
        a = 1 / self.scale
        back = np.array([[a, 0, self.left + a / 2], [0, a, self.top + a / 2]])
        how = (cv2.INTER_CUBIC if self.scale > 1 else cv2.INTER_LINEAR) | cv2.WARP_INVERSE_MAP
        out = cv2.warpAffine(
            rgb, back, (self.width, self.height), flags=how, borderMode=cv2.BORDER_REPLICATE
        )
        for line, start, size in (
            (out, self.top, rgb.shape[0]),
            (out.swapaxes(0, 1), self.left, rgb.shape[1]),
        ):
            at = start + (np.arange(len(line)) + 0.5) / self.scale
            line[(at < -0.5) | (at > size - 0.5)] = _BEYOND
        return np.asarray(out)

    def place(self, pixels: np.ndarray) -> np.ndarray:
        """Return where the photograph's pixels are shown.  (*, 2) [px] -> (*, 2) [px]."""
        return (np.asarray(pixels, np.float64) - [self.left, self.top]) * self.scale - 0.5

    def outline(
        self,
        picture: np.ndarray,
        outlines: Sequence[np.ndarray],
        color: Color,
        width: int,
        halo: bool = True,
    ) -> None:
        """Draw closed lines of the photograph, each (P, 2) [px], into what is shown of it."""
        placed = [self.place(line) for line in outlines]
        draw_lines(picture, placed, color, width, closed=True, halo=halo)

    def camera(self, K: np.ndarray) -> np.ndarray:
        """Return the camera matrix of what is shown.  (3, 3) [px] -> (3, 3)."""
        out = np.array(K, np.float64)
        out[:2] *= self.scale
        out[:2, 2] = self.place(np.asarray(K, np.float64)[:2, 2])
        return out

    def finer(self, factor: int) -> "View":
        """Return the same part at a multiple of the size."""
        return View(
            self.left, self.top, self.scale * factor, self.width * factor, self.height * factor
        )


def full_view(height: int, width: int, shown: int) -> View:
    """Return the view of a whole photograph, `shown` pixels wide."""
    scale = shown / width
    return View(-0.5, -0.5, scale, shown, round(height * scale))


def close_up(points: np.ndarray, height: int, width: int, shown: int, margin: float = 0.25) -> View:
    """Return a view round places (P, 2) [px], as wide to high as the photograph, and no larger than
    it.
    """
    low, high = points.min(0), points.max(0)
    reach = float(
        max(1.0, *((high - low) / 2 * (1 + 2 * margin) / [width, height] * max(width, height)))
    )
    share = min(1.0, 2 * reach / max(width, height))
    size = np.array([width, height]) * share
    corner = np.clip((low + high) / 2 - size / 2, -0.5, np.array([width, height]) - 0.5 - size)
    scale = shown / float(size[0])
    return View(float(corner[0]), float(corner[1]), scale, shown, round(float(size[1]) * scale))


def draw_lines(
    picture: np.ndarray,
    paths: Sequence[np.ndarray],
    color: Color,
    width: int,
    closed: bool = False,
    halo: bool = True,
) -> None:
    """Draw anti-aliased lines, with a dark halo so that they show on any ground.  paths: each (P,
    2) [px].
    """
    fixed = [
        np.round(np.clip(path, -_FARTHEST, _FARTHEST) * 2**_SHIFT).astype(np.int32)
        for path in paths
        if len(path) > 1
    ]
    if not fixed:
        return
    if halo:
        cv2.polylines(picture, fixed, closed, _HALO, width + 2, cv2.LINE_AA, _SHIFT)
    cv2.polylines(picture, fixed, closed, color, width, cv2.LINE_AA, _SHIFT)


def split_dashes(path: np.ndarray, closed: bool, dash: int = 11, gap: int = 8) -> list[np.ndarray]:
    """Cut a line into dashes of equal length.

    Args:
        path: (P, 2) [px].
        closed: Whether it goes on from its last point to its first.
        dash: Length of a dash [px].
        gap: Length between two dashes [px], about.

    Returns:
        Each (dash + 1, 2) [px], a point each pixel; a line that is shorter is one dash.
    """
    points = np.asarray(path, np.float64)
    points = np.concatenate([points, points[:1]]) if closed else points
    length = np.r_[0.0, np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum()]
    count = max(1, round(float(length[-1]) / (dash + gap)))
    starts = np.arange(count) * (length[-1] / count)
    at = np.minimum(starts[:, None] + np.arange(dash + 1), length[-1])
    return [np.stack([np.interp(one, length, points[:, i]) for i in (0, 1)], 1) for one in at]


def draw_tag(picture: np.ndarray, text: str, at: tuple[float, float], color: Color) -> None:
    """Write a short text into a picture, in place, with a dark rim so that it shows on any ground.

    Args:
        picture: (H, W, 3) uint8.
        text: What is written.
        at: Where its lower left corner goes (u, v) [px]; moved so that it stays in the picture.
        color: Of the letters.
    """
    letters = load_font(_TAG, bold=True)
    left, top, right, bottom = letters.getbbox(text, anchor="ls", stroke_width=2)
    u = float(np.clip(at[0], -left, max(picture.shape[1] - right, -left)))
    v = float(np.clip(at[1], -top, max(picture.shape[0] - bottom, -top)))
    image = Image.fromarray(picture)
    pen = ImageDraw.Draw(image)
    pen.text((u, v), text, color, letters, anchor="ls", stroke_width=2, stroke_fill=_HALO)
    picture[:] = np.asarray(image)


def draw_dots(
    picture: np.ndarray, pixels: np.ndarray, colors: np.ndarray | Color, radius: float | np.ndarray
) -> None:
    """Draw anti-aliased discs, later ones on top.

    (P, 2) [px], one color or (P, 3) uint8, one radius or (P,) [px].
    """
    at = np.round(np.clip(pixels, -_FARTHEST, _FARTHEST) * 2**_SHIFT).astype(int)
    sizes = np.broadcast_to(np.round(np.asarray(radius) * 2**_SHIFT).astype(int), len(at))
    paint = np.broadcast_to(colors, (len(at), 3))
    for (u, v), color, size in zip(at.tolist(), paint.tolist(), sizes.tolist(), strict=True):
        cv2.circle(picture, (u, v), size, color, -1, cv2.LINE_AA, _SHIFT)


def stamp_dots(picture: np.ndarray, pixels: np.ndarray, colors: np.ndarray, radius: int) -> None:
    """Draw discs at whole pixels and without smooth rims, many at once, later ones on top.

    (P, 2) [px], (P, 3) uint8.
    """
    line = np.arange(-radius, radius + 1)
    disc = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
    disc = disc[(disc * disc).sum(1) <= radius * (radius + 0.5)]
    places = np.round(np.clip(pixels, -_FARTHEST, _FARTHEST)).astype(int)
    at = (places[:, None] + disc).reshape(-1, 2)
    seen = ((at >= 0) & (at < [picture.shape[1], picture.shape[0]])).all(1)
    picture[at[seen, 1], at[seen, 0]] = np.repeat(colors, len(disc), axis=0)[seen]


def halve(picture: np.ndarray) -> np.ndarray:
    """Return a picture at half its size, each pixel the mean of four: what was drawn at twice the
    size is smooth.
    """
    size = (picture.shape[1] // 2, picture.shape[0] // 2)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


@cache
def load_font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """Return the lettering that comes with matplotlib."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size)


def draw_row(
    width: int, text: str, entries: Sequence[tuple[str, Color]] = (), size: int = 15
) -> np.ndarray:
    """Return a row of writing: text at the left, a legend of colored lines at the right.  -> (h,
    width, 3) uint8.

    Writing that does not fit beside the legend goes on a line of its own.
    """
    letters = load_font(size)
    legend = sum(28 + letters.getlength(label) + 16 for label, _ in entries)
    rows = 2 if text and entries and letters.getlength(text) + 24 + legend > width else 1
    line = round(size * 1.9)
    figure = Image.new("RGB", (width, line * rows), PAPER)
    pen = ImageDraw.Draw(figure)
    pen.text((8, line / 2), text, fill=INK, font=letters, anchor="lm")
    left, middle = (width - legend if rows == 1 and text else 8.0), line * (rows - 0.5)
    for label, color in entries:
        pen.line([(left, middle), (left + 22, middle)], fill=color, width=4)
        pen.text((left + 28, middle), label, fill=INK, font=letters, anchor="lm")
        left += 28 + letters.getlength(label) + 16
    return np.asarray(figure)


def arrange_grid(tiles: Sequence[np.ndarray], columns: int, gap: int = 6) -> np.ndarray:
    """Lay tiles out in rows, each row as high as its highest tile, each column as wide as the
    widest.  -> picture.
    """
    columns = min(columns, len(tiles))
    width = max(tile.shape[1] for tile in tiles)
    rows = []
    for i in range(0, len(tiles), columns):
        own = tiles[i : i + columns]
        height = max(tile.shape[0] for tile in own)
        row = np.full((height + gap, columns * (width + gap) + gap, 3), PAPER, np.uint8)
        for k, tile in enumerate(own):
            left = gap + k * (width + gap)
            row[: tile.shape[0], left : left + tile.shape[1]] = tile
        rows.append(row)
    return np.concatenate(rows)


def create_figure(width_px: int, height_px: int, dpi: int = 100) -> Figure:
    """Return an empty figure that draws itself with Agg, without matplotlib's global state."""
    figure = Figure(figsize=(width_px / dpi, height_px / dpi), dpi=dpi)
    FigureCanvasAgg(figure)
    return figure


def rasterize(figure: Figure) -> np.ndarray:
    """Return a figure as a picture."""
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def to_png(picture: np.ndarray) -> bytes:
    """Return a picture as the bytes of a PNG, packed quickly rather than tightly."""
    stream = BytesIO()
    Image.fromarray(picture).save(stream, "PNG", compress_level=2)
    return stream.getvalue()


def to_jpeg(picture: np.ndarray) -> bytes:
    """Return a picture as the bytes of a JPEG, its colors as sharp as its brightness: lines are
    thin.
    """
    stream = BytesIO()
    Image.fromarray(picture).save(stream, "JPEG", quality=85, subsampling=0)
    return stream.getvalue()


def save_image(picture: np.ndarray, path: str | Path) -> None:
    """Write a picture as PNG, its folder made where it is missing.

    Raises:
        UserError: It is no picture, or cannot be written.
    """
    write_whole(Path(path), to_png(to_picture(picture)))
