"""One frame of a video, and the part of it about the object, at no more pixels than tracking needs.

What a filter costs does not depend on the image's size, but what its network costs does. While the
object's place is known, the network is given a square window about it.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np

from posefilter.confidence.blank import find_blank
from posefilter.data.resize import network_size
from posefilter.images import Images, drop_unknown, make_batch, make_sized_batch
from posefilter.types import Batch, ObjectModel

_CELL = 32  # [px] the network's coarsest cell


class Window(NamedTuple):
    """A rectangle of whole pixels of a photograph, and the size at which it is seen."""

    left: int  # [px] of the photograph
    top: int
    width: int
    height: int
    seen_width: int  # [px] of what the network is given
    seen_height: int


class Frame:
    """A photograph, and what objects that look at it have in common.

    Args:
        images: One photograph.
    """

    def __init__(self, images: Images) -> None:
        self.images = images._replace(depth=drop_unknown(images.depth))
        self._whole: dict[tuple[int | None, int | None], Batch] = {}

    @cached_property
    def blank(self) -> str:
        """Why it cannot be judged, in words; "" where it can be."""
        return find_blank(self.images.rgb[0], self.images.depth[0])

    def see_whole(self, size: tuple[int | None, int | None]) -> Batch:
        """Return the whole photograph at a size; of each size it is made once.

        Args:
            size: Width and height that a network was trained on [px]; None: see `make_batch`.
        """
        if size not in self._whole:
            self._whole[size] = make_batch(self.images, *size)
        return self._whole[size]

    def shrink(self, size: tuple[int | None, int | None]) -> tuple[np.ndarray, np.ndarray]:
        """Return single pixels of the depth (H', W') [m], about as many as a network sees of the
        whole photograph, and their camera matrix (3, 3) [px].

        Args:
            size: As of `see_whole`.
        """
        height, width = self.images.depth.shape[1:]
        step = max(1, round(width / network_size(height, width, *size)[1]))
        K = self.images.intrinsics[0].astype(float)
        K[:2] /= step
        return self.images.depth[0, ::step, ::step], K

    def see_window(self, window: Window) -> Batch:
        """Return a part of the photograph."""
        part = cut_window(self.images, window)
        # its sides are whole pixels of both, so that it may be stretched by one of them
        return make_sized_batch(part, window.seen_height, window.seen_width)


def place_window(
    pose: np.ndarray,
    object_model: ObjectModel,
    K: np.ndarray,
    size: tuple[int, int],
    scale: float,
    side: int,
    window_scale: float,
) -> Window | None:
    """Return the window about an object.

    Args:
        pose: (4, 4) camera_from_object [m], where the object is expected.
        object_model: The object.
        K: (3, 3) camera matrix of the photograph [px].
        size: Height and width of the photograph [px].
        scale: Seen pixels for one of the photograph's, at most; that of training.
        side: Seen pixels of the window's side, at most.
        window_scale: Half the window's side, in projected radii of the object.

    Returns:
        The window, cut at the photograph's edges; None where it would hold next to nothing of the
        photograph, or where the object is behind the camera.
    """
    x, y, z = (pose[:3, :3] @ object_model.center.double().numpy() + pose[:3, 3]).tolist()
    if z <= object_model.radius / 2:
        return None
    half = window_scale * object_model.radius * float(K[0, 0]) / z
    scale = min(scale, side / (2 * half))
    # a whole number of the network's cells, so that no pixel is padding
    cells = min(-(-round(2 * half * scale) // _CELL), side // _CELL)
    seen = max(2, cells) * _CELL
    half = seen / scale / 2
    u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
    height, width = size
    left, columns = _cut(u - half, u + half, width, scale)
    top, rows = _cut(v - half, v + half, height, scale)
    if min(columns, rows) < _CELL:
        return None
    return Window(left, top, round(columns / scale), round(rows / scale), columns, rows)


def cut_window(images: Images, window: Window) -> Images:
    """Return the part of photographs that a window shows, with its camera."""
    rows = slice(window.top, window.top + window.height)
    columns = slice(window.left, window.left + window.width)
    K = images.intrinsics.copy()
    K[:, 0, 2] -= window.left
    K[:, 1, 2] -= window.top
    return Images(images.rgb[:, rows, columns], images.depth[:, rows, columns], K)


def _cut(low: float, high: float, size: int, scale: float) -> tuple[int, int]:
    """Return the first pixel, an even one so that halving averages the pixels that it averages in
    the whole photograph, and the number of seen pixels within the photograph.
    """
    even = 2 * round(low / 2)
    first, last = max(0, even), min(size, even + high - low)
    return first, int((last - first) * scale + 1e-6)
