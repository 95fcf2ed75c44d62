"""Draw frames of a dataset with the outline of the mesh, and how far measured and rendered depth
are apart.
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from posefilter.data.checking.compare import Fit, View
from posefilter.data.frames import tight_box
from posefilter.files import write_whole

_SIDE, _TEXT = 256, 20  # [px] of a tile and its line of text
_RANGE = 0.02  # [m] of depth difference at full color


def tile(view: View, fit: Fit, title: str) -> np.ndarray:
    """Return the photo with both outlines (mesh green, mask red) beside the depth difference.  ->
    (276, 512, 3) uint8.
    """
    sample = view.sample
    silhouette = fit.rendered > 0
    left, top, right, bottom = _square(tight_box(silhouette | sample.mask), sample.mask.shape)
    scale = _SIDE / (right - left)
    photo = _cut(sample.rgb, (left, top, right, bottom), cv2.INTER_LINEAR)
    for mask, color in ((sample.mask, (255, 60, 60)), (silhouette, (60, 255, 60))):
        part = _cut(mask.astype(np.uint8), (left, top, right, bottom), cv2.INTER_NEAREST)
        outlines, _ = cv2.findContours(part, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(photo, outlines, -1, color, 2 if scale > 1.5 else 1)
    both = silhouette & sample.mask & (sample.depth > 0)
    difference = np.where(both, sample.depth - fit.rendered, 0) / _RANGE
    colors = np.full((*difference.shape, 3), 40, np.uint8)
    colors[both] = _diverging(difference[both])
    picture = np.concatenate(
        [photo, _cut(colors, (left, top, right, bottom), cv2.INTER_NEAREST)], axis=1
    )
    line = np.zeros((_TEXT, 2 * _SIDE, 3), np.uint8)
    text = f"{title}  IoU {fit.iou:.3f}  depth {fit.depth_error_mm:.1f} mm"
    cv2.putText(
        line, text, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (230, 230, 230), 1, cv2.LINE_AA
    )
    return np.concatenate([line, picture])


def write_sheet(path: Path, tiles: Sequence[np.ndarray], columns: int = 3) -> None:
    """Write tiles as one PNG, row by row."""
    rows = [list(tiles[at : at + columns]) for at in range(0, len(tiles), columns)]
    for row in rows:
        row.extend([np.zeros_like(tiles[0])] * (min(columns, len(tiles)) - len(row)))
    sheet = np.concatenate([np.concatenate(row, axis=1) for row in rows])
    sheet = np.concatenate([legend(sheet.shape[1]), sheet])
    done, packed = cv2.imencode(".png", sheet[..., ::-1])
    assert done
    write_whole(path, packed.tobytes())


def legend(width: int) -> np.ndarray:
    """Return a line that explains the tiles' colors, narrowest sheet one tile.  -> (h, width, 3)
    uint8.
    """
    entries = (
        ("left: rendered outline", (60, 255, 60)),
        ("the dataset's mask", (255, 60, 60)),
        ("right: measured depth nearer", (90, 120, 255)),
        ("farther", (255, 90, 90)),
        (f"full color at {1000 * _RANGE:.0f} mm", (245, 245, 245)),
    )
    lines = [np.zeros((_TEXT, width, 3), np.uint8)]
    at = 4
    for text, color in entries:
        size = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.42, 1)[0][0]
        if at + size > width:
            lines.append(np.zeros((_TEXT, width, 3), np.uint8))
            at = 4
        cv2.putText(
            lines[-1], text, (at, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, color, 1, cv2.LINE_AA
        )
        at += size + 18
    return np.concatenate(lines)


def _square(box: tuple[int, int, int, int], shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """Return a square round the box, with a margin; it may reach beyond the picture."""
    left, top, right, bottom = box if box[2] > box[0] else (0, 0, shape[1], shape[0])
    half = round(max(right - left, bottom - top, 16) * 0.6)
    x, y = (left + right) // 2, (top + bottom) // 2
    return x - half, y - half, x + half, y + half


def _cut(image: np.ndarray, box: tuple[int, int, int, int], interpolation: int) -> np.ndarray:
    left, top, right, bottom = box
    height, width = image.shape[:2]
    border = (max(-top, 0), max(bottom - height, 0), max(-left, 0), max(right - width, 0))
    inside = image[max(top, 0) : min(bottom, height), max(left, 0) : min(right, width)]
    padded = cv2.copyMakeBorder(inside, *border, cv2.BORDER_CONSTANT, value=0)
    return np.ascontiguousarray(cv2.resize(padded, (_SIDE, _SIDE), interpolation=interpolation))


def _diverging(x: np.ndarray) -> np.ndarray:
    """Return blue for -1 (measured nearer), white for 0, red for 1.  (P,) -> (P, 3) uint8."""
    x = np.clip(x, -1, 1)[:, None]
    red, blue, white = (
        np.array([[200, 30, 30]]),
        np.array([[30, 60, 200]]),
        np.array([[245, 245, 245]]),
    )
    return (white + np.abs(x) * (np.where(x > 0, red, blue) - white)).astype(np.uint8)
