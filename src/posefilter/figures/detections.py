"""Draw several objects onto a photograph, each in a color of its own: what is found with a full
outline, what is unsure with dashes; what is absent is only named.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from posefilter.figures.canvas import Color, draw_row, draw_tag, full_view, load_font
from posefilter.figures.layout import draw_legend, wrap_text
from posefilter.figures.overlay import WIDTH, Shape, draw_pose, outline_object

_LETTERS = 15  # [px] of a row
_LINE = 18  # [px] from one tag to the next


class Drawn(NamedTuple):
    """One object that is drawn."""

    label: str  # in the legend
    pose: np.ndarray  # (4, 4) camera_from_object [m]
    shape: Shape
    tag: str = ""  # written above its outline
    dashed: bool = False


def draw_detections(
    rgb: np.ndarray,
    intrinsics: np.ndarray,
    detections: Sequence[Drawn],
    absent: Sequence[str] = (),
    caption: str = "",
) -> np.ndarray:
    """Draw where poses put several objects, the nearest last.

    Args:
        rgb: (H, W, 3) uint8.
        intrinsics: Its camera matrix (3, 3) [px].
        detections: What is drawn.
        absent: Names that the legend says are not in the image.
        caption: What is written below the legend.

    Returns:
        The picture (h, w, 3) uint8, with the legend below.
    """
    view = full_view(rgb.shape[0], rgb.shape[1], max(WIDTH, rgb.shape[1]))
    picture, shown = view.show(rgb), view.camera(intrinsics)
    colors = pick_colors(len(detections))
    for i in sorted(range(len(detections)), key=lambda i: -detections[i].pose[2, 3]):
        one, pose = detections[i], np.asarray(detections[i].pose, np.float64)
        draw_pose(picture, shown, pose, one.shape, colors[i], dashed=one.dashed)
    _draw_tags(picture, shown, detections, colors)
    entries = [(one.label, color) for one, color in zip(detections, colors, strict=True)]
    rows = [draw_legend(entries, picture.shape[1], _LETTERS)] if entries else []
    names, room = f"absent: {', '.join(absent)}", picture.shape[1] - 16
    texts = wrap_text(names, load_font(_LETTERS), room) if absent else []
    texts += wrap_text(caption, load_font(_LETTERS), room) if caption else []
    rows += [draw_row(picture.shape[1], text, size=_LETTERS) for text in texts]
    return np.concatenate([picture, *rows])


def pick_colors(count: int) -> list[Color]:
    """Return colors that are told apart, of hues that lie apart."""
    hues = [(150 + 180 * 0.618034 * i) % 180 for i in range(count)]  # OpenCV's, of 180
    hsv = np.array([[[hue, 190 if i % 2 else 230, 255] for i, hue in enumerate(hues)]], np.uint8)
    rgb = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0] if count else np.zeros((0, 3), np.uint8)
    return [(int(r), int(g), int(b)) for r, g, b in rgb]


def _draw_tags(
    picture: np.ndarray, K: np.ndarray, detections: Sequence[Drawn], colors: Sequence[Color]
) -> None:
    """Write each tag above its object's outline, none of them over another."""
    height, width = picture.shape[:2]
    taken: list[tuple[float, float]] = []
    for one, color in zip(detections, colors, strict=True):
        lines = outline_object(np.asarray(one.pose, np.float64), one.shape, K, height, width)
        if not one.tag or not lines:
            continue
        points = np.clip(np.concatenate(lines), 0, [width - 1, height - 1])
        u, v = float(points[:, 0].min()), max(float(points[:, 1].min()) - 4, _LINE)
        while any(abs(v - b) < _LINE and abs(u - a) < 160 for a, b in taken):
            v += _LINE
        taken.append((u, v))
        draw_tag(picture, one.tag, (u, v), color)
