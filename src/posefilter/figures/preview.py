"""Draw some frames of a dataset: the photograph with the object's visible part outlined, and the
depth below it.
"""

from collections.abc import Sequence
from contextlib import suppress

import cv2
import numpy as np
from matplotlib import colormaps

from posefilter.data.frames import FrameRecord, Sample
from posefilter.data.readers.base import BaseReader
from posefilter.data.splits import ImageKey, image_key
from posefilter.errors import BadData
from posefilter.figures.canvas import PAPER, TRUTH, arrange_grid, draw_row, full_view
from posefilter.figures.layout import DETAIL, draw_legend, draw_scale
from posefilter.figures.overlay import trace_outline

_TILE = 320  # [px]
_SHOWN = 4  # frames
_DEPTH = colormaps["viridis"]
_UNKNOWN = (40, 40, 40)


def draw_preview(reader: BaseReader, name: str, frames: int) -> np.ndarray | None:
    """Return four of a dataset's frames, spread evenly, each with its depth below it.

    A frame of two cameras is shown as one of them sees it. Frames that cannot be read are left out;
    None where that leaves none, or none shows the object.
    """
    records = reader.records()
    images = _list_images(records)
    spread = np.linspace(0, len(images) - 1, min(_SHOWN, len(images)))
    chosen = [images[i] for i in np.unique(spread.round().astype(int))]
    read = [(records[image[0]].name, _read_instances(reader, image)) for image in chosen]
    found = [(title, samples) for title, samples in read if samples]
    if not found:
        return None
    depths = [samples[0].depth for _, samples in found]
    known = np.concatenate([depth[depth > 0] for depth in depths])
    near, far = np.quantile(known, [0.01, 0.99])
    tiles = [draw_frame(samples, title, float(near), float(far)) for title, samples in found]
    if len(tiles) == 1:  # the rows above and below need the width of two
        tiles.append(np.full_like(tiles[0], 255))
    figure = arrange_grid(tiles, len(tiles))
    title = f"{name}: {len(found)} of {frames} frames"
    head = draw_row(figure.shape[1], title, [("visible part", TRUTH)], size=18)
    return np.concatenate(
        [head, figure, draw_depth_scale(figure.shape[1], float(near), float(far))]
    )


def _list_images(records: Sequence[FrameRecord]) -> list[list[int]]:
    """Return an image of each frame, as the indices of its records: one an instance."""
    images: dict[ImageKey, list[int]] = {}
    for i, record in enumerate(records):
        listed = images.setdefault(image_key(record), [])
        if not listed or records[listed[0]].name == record.name:  # else of the other camera
            listed.append(i)
    return list(images.values())


def _read_instances(reader: BaseReader, image: Sequence[int]) -> list[Sample]:
    """Return those of an image's instances that can be read."""
    found = []
    for index in image:
        with suppress(BadData):
            found.append(reader.read(index))
    return found


def draw_frame(instances: Sequence[Sample], name: str, near: float, far: float) -> np.ndarray:
    """Return a frame's name, its photograph with the instances outlined, and its depth colored from
    `near` to `far` [m].
    """
    sample = instances[0]
    height, width = sample.mask.shape
    view = full_view(height, width, _TILE)
    size = (view.width, view.height)
    how = cv2.INTER_AREA if view.scale < 1 else cv2.INTER_CUBIC
    photo = cv2.resize(sample.rgb, size, interpolation=how)
    for instance in instances:
        view.outline(photo, trace_outline(instance.mask), TRUTH, 1)
    share = (np.clip(sample.depth, near, far) - near) / max(far - near, 1e-9)
    depth = (_DEPTH(share)[..., :3] * 255).astype(np.uint8)
    depth[sample.depth <= 0] = _UNKNOWN
    depth = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST)
    gap = np.full((4, _TILE, 3), PAPER, np.uint8)
    return np.concatenate([draw_row(_TILE, name, size=14), photo, gap, depth])


def draw_depth_scale(width: int, near: float, far: float) -> np.ndarray:
    """Return a row that explains the colors of the depth."""
    ramp = (_DEPTH(np.linspace(0, 1, 256))[:, :3] * 255).astype(np.uint8)
    scale = draw_scale(f"depth: {near:.2f} m", ramp, f"{far:.2f} m", _TILE, DETAIL)
    legend = draw_legend([("unknown", _UNKNOWN)], width - _TILE, DETAIL)
    return np.concatenate([scale, legend], axis=1)
