"""Draw frames of a dataset with the outline of the mesh, and how far measured and rendered depth
are apart.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from posefilter.checking.compare import Fit, View
from posefilter.data.frames import tight_box
from posefilter.figures import canvas
from posefilter.figures.layout import DETAIL, add_caption, draw_legend
from posefilter.figures.overlay import trace_outline
from posefilter.figures.panels import map_colors

_SIDE = 256  # [px] of a tile's two pictures
_RANGE = 0.02  # [m] of depth difference at full color
_RENDERED, _LABELED, _UNKNOWN = (60, 255, 60), (255, 60, 60), (40, 40, 40)
_NEARER, _FARTHER = map_colors(np.array([-1, 1]), -1, 1, "RdBu_r").tolist()
_ENTRIES = [
    ("left: rendered outline", _RENDERED),
    ("the dataset's mask", _LABELED),
    ("right: measured depth nearer", tuple(_NEARER)),
    (f"farther, full color at {1000 * _RANGE:.0f} mm", tuple(_FARTHER)),
]


def tile(view: View, fit: Fit, title: str) -> np.ndarray:
    """Return the photo with both outlines (mesh green, mask red) beside the depth difference, under
    a caption.  -> (h, 512, 3) uint8.
    """
    sample, silhouette = view.sample, fit.rendered > 0
    part = _close_up(silhouette | sample.mask)
    photo = part.show(sample.rgb)
    for mask, color in ((sample.mask, _LABELED), (silhouette, _RENDERED)):
        part.outline(photo, trace_outline(mask), color, 2, halo=False)
    both = silhouette & sample.mask & (sample.depth > 0)
    colors = map_colors(sample.depth - fit.rendered, -_RANGE, _RANGE, "RdBu_r")
    colors[~both] = _UNKNOWN
    text = f"{title}  IoU {fit.iou:.3f}  depth {fit.depth_error_mm:.1f} mm"
    return add_caption(np.concatenate([photo, part.show(colors)], axis=1), text, DETAIL)


def write_sheet(path: Path, tiles: Sequence[np.ndarray]) -> None:
    """Write tiles as one PNG, row by row, under what their colors mean."""
    sheet = canvas.arrange_grid(tiles, columns=3)
    legend = draw_legend(_ENTRIES, sheet.shape[1], DETAIL)
    canvas.save_image(np.concatenate([legend, sheet]), path)


def _close_up(mask: np.ndarray) -> canvas.View:
    """Return a square view round a mask, with a margin; it may reach beyond the picture."""
    left, top, right, bottom = tight_box(mask)
    if right <= left:
        (bottom, right), left, top = mask.shape, 0, 0
    half = 0.6 * max(right - left, bottom - top, 16)
    x, y = (left + right) / 2 - half, (top + bottom) / 2 - half
    return canvas.View(x, y, _SIDE / (2 * half), _SIDE, _SIDE)
