"""An animation of the filter at work, and silhouettes of its particles: poses or pixels, from one
iteration to the next; and its encoding as a GIF.
"""

from collections.abc import Iterator, Sequence
from io import BytesIO
from itertools import islice, repeat
from typing import Any

import numpy as np
import torch
from matplotlib import colormaps
from PIL import Image

from posefilter.figures.canvas import INK, PAPER, TRUTH, close_up, full_view, stamp_dots
from posefilter.figures.layout import WIDTH, add_caption, center_part, compose_figure, draw_legend
from posefilter.figures.panels import arrange_row
from posefilter.figures.particles import (
    choose_by_weight,
    choose_steps,
    color_by_weight,
    describe_noise,
    draw_weight_scale,
    fade,
    normalize_weights,
)
from posefilter.figures.silhouettes import _LINE, outline_hulls, project_hulls
from posefilter.geometry.camera import project
from posefilter.geometry.pose import origin_of
from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Space
from posefilter.types import Trace

_COLORS = 120  # of an animation
# colors that an animation's palette must have, however few of its pixels show them: weights, lines,
# writing
_KEPT = np.concatenate(
    [
        colormaps["plasma"](np.linspace(0, 1, 20))[:, :3] * 255,
        [TRUTH, _LINE, INK, PAPER, (150, 152, 156)],
    ]
)


class Animation:
    """An animation of one image's particles, from each iteration to the next.

    rgb (H, W, 3) uint8; K (3, 3) [px]; trace: of one image; hull (V, 3) [m]; target: lines round
    the true object [px]. Pixels are dots, colored by weight. Poses are outlines of some and the
    centers of all, on the frame and, beside it, close up.
    """

    def __init__(
        self,
        rgb: np.ndarray,
        K: np.ndarray,
        trace: Trace,
        space: Space,
        hull: torch.Tensor,
        target: Sequence[np.ndarray],
        title: str = "The filter at work",
    ) -> None:
        self.camera = torch.as_tensor(np.asarray(K), dtype=torch.float64)
        self.trace, self.space, self.hull, self.target = trace, space, hull, target
        height, wide = rgb.shape[:2]
        self.posed = isinstance(space, PoseSpace)
        self.views = [full_view(height, wide, WIDTH // 2 if self.posed else 480)]
        if self.posed and target:
            places = np.concatenate(list(target))
            self.views.append(close_up(places, height, wide, WIDTH // 2, margin=0.4))
        self.grounds = [fade(view.show(rgb), 0.5) for view in self.views]
        self.head = compose_figure(title)
        entries = [("truth", TRUTH), *([("some outlines", _LINE)] if self.posed else [])]
        self.foot = np.concatenate([draw_legend(entries), draw_weight_scale()])

    def frames(self, between: int | None = None, max_steps: int = 15) -> Iterator[np.ndarray]:
        """Yield the pictures, `between` of them from each iteration to the next; None: two where
        iterations are few, else one.

        max_steps: iterations that are shown, evenly chosen, the first and the last among them.
        """
        shown = choose_steps(len(self.trace.particles), max_steps)
        between = between or (2 if len(shown) <= 8 else 1)
        for before, number in zip([shown[0], *shown], shown, strict=False):
            weights = normalize_weights(self.trace.particles[number])
            few = choose_by_weight(weights, 24).unique()
            ancestors = self.ancestors(number, before)
            ends = self.drawn(number, torch.arange(len(weights)), few)
            starts = self.drawn(before, ancestors, ancestors[few])
            noise = describe_noise(self.trace, number, "mm" if self.posed else "px")
            caption = f"step {number} of {len(self.trace.particles) - 1}: {noise}"
            for k in range(between if number else 1):
                share = (k + 1) / between
                dots, lines = (a + share * (b - a) for a, b in zip(starts, ends, strict=True))
                yield self.frame(dots, lines, weights.numpy(), caption)

    def ancestors(self, number: int, before: int) -> torch.Tensor:
        """Return which particles of an earlier iteration those of one stem from; themselves, if
        that is the same.  -> (N,).
        """
        index = torch.arange(self.trace.particles[number].state.shape[1])
        for particles in self.trace.particles[number:before:-1]:
            index = particles.ancestors[0].cpu()[index]
        return index

    def drawn(
        self, number: int, dots: torch.Tensor, lines: torch.Tensor
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return chosen particles' dots (N, 2), and the corners of others' outlines (n, V, 2), none
        for pixels.  [px]
        """
        if not isinstance(self.space, PoseSpace):
            state = self.trace.particles[number].state[0].detach().cpu().double()
            return state[dots].numpy(), np.zeros((len(lines), 0, 2))
        poses = self.trace.outputs[number].pose[0].detach().cpu().double()
        center = torch.tensor(self.space.center, dtype=torch.float64)
        corners = project_hulls(poses[lines], self.hull, self.camera.numpy())
        return project(origin_of(poses[dots], center), self.camera).numpy(), corners

    def frame(
        self, dots: np.ndarray, corners: np.ndarray, weights: np.ndarray, caption: str
    ) -> np.ndarray:
        """Draw one picture."""
        order = np.argsort(weights, kind="stable")
        colors = color_by_weight(weights)[order]
        parts = []
        for view, ground in zip(self.views, self.grounds, strict=True):
            picture = ground.copy()
            stamp_dots(picture, view.place(dots[order]), colors, 2 if self.posed else 3)
            view.outline(picture, outline_hulls(corners), _LINE, 1, halo=False)
            view.outline(picture, self.target, TRUTH, 2)
            parts.append(picture)
        middle = add_caption(center_part(arrange_row(parts)), caption)
        return np.concatenate([self.head, middle, self.foot])


def encode_gif(
    frames: Sequence[np.ndarray],
    milliseconds: int | Sequence[int] = 220,
    hold: int = 1500,
) -> bytes:
    """Return frames as an animated GIF that loops, the one animation that TensorBoard plays; the
    last is held.

    Args:
        frames: (H, W, 3) uint8 each.
        milliseconds: How long each is shown, in whole hundredths of a second; or the time of each
            but the last.
        hold: The same of the last.
    """
    free = _COLORS - len(_KEPT)
    # as good for choosing colors, and nine times sooner
    few = np.ascontiguousarray(frames[-1][::3, ::3])
    ground = Image.fromarray(few).quantize(free, Image.Quantize.MEDIANCUT).getpalette() or []
    own = np.reshape(ground, (-1, 3))[:free]
    palette = np.concatenate([_KEPT, own]).astype(np.uint8)
    palette = np.pad(palette, ((0, _COLORS - len(palette)), (0, 0)))
    table = index_nearest_colors(palette)
    indexed = [table[(frame >> 3) @ np.array([1024, 32, 1], np.uint16)] for frame in frames]
    images = []
    for before, frame in zip([None, *indexed[:-1]], indexed, strict=True):
        # `_COLORS`: see-through
        kept = frame if before is None else np.where(frame == before, np.uint8(_COLORS), frame)
        images.append(Image.fromarray(kept, "P"))
        images[-1].putpalette(palette.tobytes())
    waits = milliseconds if isinstance(milliseconds, Sequence) else repeat(milliseconds)
    durations = [*islice(waits, len(frames) - 1), hold]
    stream = BytesIO()
    save: dict[str, Any] = {"loop": 0, "transparency": _COLORS, "disposal": 1, "optimize": False}
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
