"""Encode frames as a GIF."""

from collections.abc import Sequence
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib import colormaps
from PIL import Image

from posefilter.figures.canvas import INK, PAPER, TRUTH
from posefilter.figures.silhouettes import _LINE

# colors that an animation's palette must have, however few of its pixels show them: weights, lines,
# writing
_KEPT = np.concatenate(
    [
        colormaps["plasma"](np.linspace(0, 1, 20))[:, :3] * 255,
        [TRUTH, _LINE, INK, PAPER, (150, 152, 156)],
    ]
)


def encode_gif(
    frames: Sequence[np.ndarray], milliseconds: int = 220, hold: int = 1500, colors: int = 120
) -> bytes:
    """Return frames as an animated GIF that loops, the one animation that TensorBoard plays; the
    last is held.
    """
    free = colors - len(_KEPT)
    # as good for choosing colors, and nine times sooner
    few = np.ascontiguousarray(frames[-1][::3, ::3])
    ground = Image.fromarray(few).quantize(free, Image.Quantize.MEDIANCUT).getpalette() or []
    own = np.reshape(ground, (-1, 3))[:free]
    palette = np.concatenate([_KEPT, own]).astype(np.uint8)
    palette = np.pad(palette, ((0, colors - len(palette)), (0, 0)))
    table = index_nearest_colors(palette)
    indexed = [table[(frame >> 3) @ np.array([1024, 32, 1], np.uint16)] for frame in frames]
    images = []
    for before, frame in zip([None, *indexed[:-1]], indexed, strict=True):
        # `colors`: see-through
        kept = frame if before is None else np.where(frame == before, np.uint8(colors), frame)
        images.append(Image.fromarray(kept, "P"))
        images[-1].putpalette(palette.tobytes())
    durations = [milliseconds] * (len(frames) - 1) + [hold]
    stream = BytesIO()
    save: dict[str, Any] = {"loop": 0, "transparency": colors, "disposal": 1, "optimize": False}
    images[0].save(
        stream, "GIF", save_all=True, append_images=images[1:], duration=durations, **save
    )
    return stream.getvalue()


def index_nearest_colors(palette: np.ndarray) -> np.ndarray:
    """Return which of at most 255 colors (P, 3) is nearest to each color of 5 bits a channel.  ->
    (32^3,) uint8.
    """
    line = np.arange(32, dtype=np.float32) * 8 + 4
    places = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)
    own = palette.astype(np.float32)
    # less the place's own square, which is the same for all
    far = (own * own).sum(1) - 2 * places @ own.T
    return far.argmin(1).astype(np.uint8)
