"""An animation of the filter at work, and silhouettes of its particles: poses or pixels, from one
iteration to the next.
"""

from collections.abc import Iterator, Sequence
from io import BytesIO
from typing import Any

import cv2
import numpy as np
import torch
from matplotlib import colormaps
from PIL import Image

from posefilter.figures.canvas import (
    INK,
    PAPER,
    TRUTH,
    View,
    arrange_grid,
    close_up,
    draw_lines,
    full_view,
    stamp_dots,
)
from posefilter.figures.layout import (
    CAPTION,
    WIDTH,
    add_caption,
    center_part,
    compose_figure,
    draw_legend,
    draw_text,
    tile_width,
)
from posefilter.figures.panels import arrange_row, draw_color_scale
from posefilter.figures.particles import (
    choose_by_weight,
    choose_steps,
    color_by_weight,
    describe_noise,
    describe_step,
    draw_weight_scale,
    fade,
    normalize_weights,
)
from posefilter.geometry.camera import project
from posefilter.geometry.pose import origin_of, transform
from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Space
from posefilter.types import Trace

_LINE = (255, 225, 120)
# colors that a animation's palette must have, however few of its pixels show them: weights, lines,
# writing
_KEPT = np.concatenate(
    [
        colormaps["plasma"](np.linspace(0, 1, 20))[:, :3] * 255,
        [TRUTH, _LINE, INK, PAPER, (150, 152, 156)],
    ]
)


def project_hulls(poses: torch.Tensor, hull: torch.Tensor, K: np.ndarray) -> np.ndarray:
    """Return where poses put the points of a convex hull.  (N, 4, 4), (V, 3) [m], (3, 3) -> (N, V,
    2) [px].

    Not a number where any of a pose's points lies behind the camera: its outline means nothing.
    """
    points = transform(poses, hull.to(poses))
    pixels = project(points, torch.as_tensor(np.asarray(K)).to(poses))
    behind = (points[..., 2] < 0.01).any(1)
    return torch.where(behind[:, None, None], torch.nan, pixels).numpy()


def outline_hulls(pixels: np.ndarray) -> list[np.ndarray]:
    """Return the convex outline of each pose's points, none where these are not numbers.

    (N, V, 2) -> each (P, 2).
    """
    return [
        cv2.convexHull(one.astype(np.float32))[:, 0]
        for one in pixels
        if one.size and np.isfinite(one).all()
    ]


def compute_coverage(pixels: np.ndarray, weights: np.ndarray, view: View) -> np.ndarray:
    """Return the weight of the poses whose silhouette covers each shown pixel.

    (N, V, 2) [px], (N,) -> (h, w) float32.
    """
    total = np.zeros((view.height, view.width), np.float32)
    for one, weight in zip(pixels, weights, strict=True):
        if np.isfinite(one).all():
            corners = cv2.convexHull(
                np.round(view.place(one)).clip(-16_000, 16_000).astype(np.int32)
            )
            (left, top), (right, bottom) = corners.min((0, 1)).clip(0), corners.max((0, 1)) + 1
            # no more of the picture is looked at than the silhouette needs
            part = total[top:bottom, left:right]
            if part.size:
                layer = np.zeros(part.shape, np.uint8)
                cv2.fillConvexPoly(layer, corners - [left, top], 1)
                part += np.float32(weight) * layer
    return total


def draw_silhouettes(
    rgb: np.ndarray, K: np.ndarray, trace: Trace, hull: torch.Tensor, truth: np.ndarray, title: str
) -> np.ndarray:
    """Draw where the poses of one image put the object, at four of the filter's steps: on the
    frame, and close up.

    trace: of one image. Color is the weight of the particles whose silhouette covers a pixel; lines
    are some outlines.
    """
    height, wide = rgb.shape[:2]
    width = tile_width(2)
    places = torch.as_tensor(np.asarray(truth))[None]
    true = project_hulls(places, hull, K)
    frame = full_view(height, wide, width)
    near = close_up(true[0], height, wide, width, margin=0.4) if np.isfinite(true).all() else frame
    grounds = [fade(view.show(rgb), 0.6) for view in (frame, near)]
    parts: list[np.ndarray] = []
    for number in choose_steps(len(trace.particles), 4):
        weights = normalize_weights(trace.particles[number], 0)
        chosen = (
            trace.particles[number].state[0].detach().cpu().double()[choose_by_weight(weights, 64)]
        )
        pixels = project_hulls(chosen, hull, K)
        tiles = []
        for view, ground in zip((frame, near), grounds, strict=True):
            share = compute_coverage(pixels, np.full(len(pixels), 1 / len(pixels)), view)
            picture = blend_coverage(ground, share)
            draw_lines(
                picture,
                [view.place(line) for line in outline_hulls(pixels[::4])],
                _LINE,
                1,
                closed=True,
                halo=False,
            )
            draw_lines(
                picture, [view.place(line) for line in outline_hulls(true)], TRUTH, 2, closed=True
            )
            tiles.append(picture)
        parts += [draw_text(describe_step(trace, 0, number, "mm"), CAPTION), arrange_grid(tiles, 2)]
    foot = [
        draw_legend([("truth", TRUTH), ("16 outlines", _LINE)]),
        draw_color_scale("weight: 0", "1", "plasma"),
    ]
    return compose_figure(title, *parts, *foot)


def blend_coverage(picture: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return a picture under a map (h, w) in [0, 1], the more opaque the higher."""
    out, on = picture.copy(), share > 0
    paint = colormaps["plasma"](np.clip(share[on], 0, 1))[:, :3] * 255
    opacity = 0.75 * np.clip(share[on] * 2, 0, 1)[:, None]
    out[on] = (picture[on] * (1 - opacity) + paint * opacity).round()
    return out


class Animation:
    """A animation of one image's particles, from each cloud to the next.

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
            self.views.append(
                close_up(np.concatenate(list(target)), height, wide, WIDTH // 2, margin=0.4)
            )
        self.grounds = [fade(view.show(rgb), 0.5) for view in self.views]
        self.head = compose_figure(title)
        entries = [("truth", TRUTH), *([("some outlines", _LINE)] if self.posed else [])]
        self.foot = np.concatenate([draw_legend(entries), draw_weight_scale()])

    def frames(self, between: int | None = None, most: int = 15) -> Iterator[np.ndarray]:
        """Yield the pictures, `between` of them from each cloud to the next; None: two where clouds
        are few, else one.

        most: clouds that are shown, evenly chosen, the first and the last among them.
        """
        shown = choose_steps(len(self.trace.particles), most)
        between = between or (2 if len(shown) <= 8 else 1)
        for before, number in zip([shown[0], *shown], shown, strict=False):
            weights = normalize_weights(self.trace.particles[number], 0)
            few = choose_by_weight(weights, 24).unique()
            ancestors = self.ancestors(number, before)
            ends = self.drawn(number, torch.arange(len(weights)), few)
            starts = self.drawn(before, ancestors, ancestors[few])
            noise = describe_noise(self.trace, 0, number, "mm" if self.posed else "px")
            caption = f"step {number} of {len(self.trace.particles) - 1}: {noise}"
            for k in range(between if number else 1):
                share = (k + 1) / between
                dots, lines = (a + share * (b - a) for a, b in zip(starts, ends, strict=True))
                yield self.frame(dots, lines, weights.numpy(), caption)

    def ancestors(self, number: int, before: int) -> torch.Tensor:
        """Return which particles of an earlier cloud a cloud's own stem from; themselves, if that
        is the same.  -> (N,).
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
        state = self.trace.particles[number].state[0].detach().cpu().double()
        if not isinstance(self.space, PoseSpace):
            return state[dots].numpy(), np.zeros((len(lines), 0, 2))
        center = torch.tensor(self.space.center, dtype=torch.float64)
        corners = project_hulls(state[lines], self.hull, self.camera.numpy())
        return project(origin_of(state[dots], center), self.camera).numpy(), corners

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
            draw_lines(
                picture,
                [view.place(x) for x in outline_hulls(corners)],
                _LINE,
                1,
                closed=True,
                halo=False,
            )
            draw_lines(picture, [view.place(x) for x in self.target], TRUTH, 2, closed=True)
            parts.append(picture)
        return np.concatenate(
            [self.head, add_caption(center_part(arrange_row(parts)), caption), self.foot]
        )


def encode_gif(
    frames: Sequence[np.ndarray], milliseconds: int = 220, hold: int = 1500, colors: int = 120
) -> bytes:
    """Return frames as an animated GIF that loops, the one animation that TensorBoard plays; the
    last is held.
    """
    # as good for choosing colors, and nine times sooner
    few = np.ascontiguousarray(frames[-1][::3, ::3])
    ground = (
        Image.fromarray(few).quantize(colors - len(_KEPT), Image.Quantize.MEDIANCUT).getpalette()
        or []
    )
    palette = np.concatenate([_KEPT, np.reshape(ground, (-1, 3))[: colors - len(_KEPT)]]).astype(
        np.uint8
    )
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
    save: dict[str, Any] = {
        "duration": durations,
        "loop": 0,
        "transparency": colors,
        "disposal": 1,
        "optimize": False,
    }
    images[0].save(stream, "GIF", save_all=True, append_images=images[1:], **save)
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
