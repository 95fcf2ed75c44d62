"""Draw clouds of particles on the image, coloured by weight: one step, or a strip of steps over the filter's run."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from matplotlib import colormaps

from posefilter.contracts import Space
from posefilter.geometry.camera import project
from posefilter.geometry.pose import origin_of
from posefilter.geometry.spaces import PoseSpace
from posefilter.pictures.canvas import (
    AXES,
    INK,
    PAPER,
    draw_dots,
    enlarge,
    enlarge_pixels,
    factor_for,
    font,
    grid,
    strip,
)
from posefilter.types import Trace

_WEIGHT = colormaps["plasma"]
_REACH = 10.0  # the colours span weights from 1 / _REACH to _REACH times the mean


def weight_colours(weights: np.ndarray) -> np.ndarray:
    """Return colours by weight over the mean weight, logarithmic, the same scale in every picture.  (N,) -> (N, 3) uint8."""
    ratio = np.maximum(weights * len(weights), 1e-12)
    level = np.clip((np.log(ratio) / math.log(_REACH) + 1) / 2, 0, 1)
    return np.asarray(_WEIGHT(level)[:, :3] * 255).round().astype(np.uint8)


def draw_cloud(
    rgb: np.ndarray,
    pixels: np.ndarray,
    weights: np.ndarray,
    axes: np.ndarray | None = None,
    caption: str = "",
    width: int = 480,
    fade: float = 0.45,
) -> np.ndarray:
    """Draw particles on a faded photograph, the heaviest on top.

    rgb (H, W, 3) uint8; pixels (N, 2) [px]; weights (N,) summing to 1; axes (M, 4, 2) [px]: centre and the ends of x, y and
    z of the poses whose axes are drawn.
    """
    factor = factor_for(rgb.shape[1], width)
    picture = enlarge(faded(rgb, fade), factor)
    if axes is not None:
        draw_many_axes(picture, enlarge_pixels(axes, factor))
    order = np.argsort(weights, kind="stable")
    radius = max(1.5, picture.shape[1] / 260)
    draw_dots(picture, enlarge_pixels(pixels[order], factor), weight_colours(weights)[order], radius)
    return np.concatenate([picture, strip(picture.shape[1], caption, size=14)]) if caption else picture


def faded(rgb: np.ndarray, share: float) -> np.ndarray:
    """Return a picture mixed with its own grey, darkened, so that colours drawn on it show."""
    grey = rgb.mean(-1, keepdims=True)
    return np.asarray(((1 - share) * rgb + share * grey) * (1 - 0.5 * share)).round().astype(np.uint8)


def draw_many_axes(picture: np.ndarray, axes: np.ndarray, opacity: float = 0.55) -> None:
    """Draw the axes of several poses, half transparent, in place.  (M, 4, 2) [px]."""
    layer = picture.copy()
    fixed = np.round(np.clip(axes, -16_000, 16_000) * 16).astype(np.int32)
    for k, colour in enumerate(AXES, start=1):
        cv2.polylines(layer, [np.ascontiguousarray(one) for one in fixed[:, [0, k]]], False, colour, 1, cv2.LINE_AA, 4)
    cv2.addWeighted(layer, opacity, picture, 1 - opacity, 0, picture)


def project_axes(poses: torch.Tensor, center: torch.Tensor, length: float, K: torch.Tensor) -> np.ndarray:
    """Return where poses put the centre and the ends of the axes.  (M, 4, 4), (3,) [m], (3, 3) -> (M, 4, 2) [px]."""
    ends = center + length * torch.cat([torch.zeros(1, 3), torch.eye(3)]).to(center)
    return project(torch.stack([origin_of(poses, end) for end in ends], dim=1), K).numpy()


def draw_strip(
    rgb: np.ndarray, K: np.ndarray, trace: Trace, image: int, space: Space, tiles: int = 6, columns: int = 3, title: str = ""
) -> np.ndarray:
    """Draw the clouds of one image over the filter's run: `tiles` steps evenly chosen, the first and the last included.

    rgb (H, W, 3) uint8; K (3, 3) [px]; image: which of the trace's. Particles in pixel space are dots; those in pose space
    are dots at the object's centre, and the axes of a few drawn by weight. From the second half of the run on, a cloud of
    poses is shown enlarged about its mean, since it has grown too small to see.
    """
    drawn = [draw_step(rgb, K, trace, image, number, space) for number in steps_shown(len(trace.clouds), tiles)]
    sheet = grid(drawn, columns)
    head = strip(sheet.shape[1], title or "The particles' way over the iterations", size=18)
    return np.concatenate([head, sheet, weight_scale(sheet.shape[1])])


def steps_shown(count: int, most: int) -> list[int]:
    """Return at most `most` of `count` steps, evenly spread, the first and the last among them."""
    return sorted({round(x) for x in np.linspace(0, count - 1, min(most, count))})


def draw_step(rgb: np.ndarray, K: np.ndarray, trace: Trace, image: int, number: int, space: Space) -> np.ndarray:
    """Draw one step of one image."""
    cloud, step = trace.clouds[number], trace.steps[number]
    state = cloud.state[image].detach().cpu().double()
    weights = torch.softmax(cloud.log_weights[image].detach().cpu().double(), 0)
    sigma = float(step.sigma if step.sigma.ndim == 0 else step.sigma[image])
    ess = float(1 / weights.square().sum() / len(weights))
    noise = f"{1000 * sigma:.3g} mm" if isinstance(space, PoseSpace) else f"{sigma:.3g} px"
    caption = f"step {number + 1} of {len(trace.clouds)}: noise {noise}, {ess:.0%} effective"
    if not isinstance(space, PoseSpace):
        return draw_cloud(rgb, state.numpy(), weights.numpy(), caption=caption)
    camera = torch.as_tensor(np.asarray(K), dtype=torch.float64)
    center = torch.tensor(space.center, dtype=torch.float64)
    pixels = project(origin_of(state, center), camera).numpy()
    axes = project_axes(state[spread_choice(weights, 24)], center, 0.6 * space.radius, camera)
    return draw_cloud(rgb, pixels, weights.numpy(), axes, caption)


def spread_choice(weights: torch.Tensor, count: int) -> torch.Tensor:
    """Choose particles by weight, without a random draw: systematic, from the middle of each share.  (N,) -> (count,)."""
    at = (torch.arange(count, dtype=weights.dtype) + 0.5) / count
    return torch.searchsorted(weights.cumsum(0), at).clamp(max=len(weights) - 1)


def weight_scale(width: int, size: int = 14) -> np.ndarray:
    """Return a strip that explains the colours."""
    from PIL import Image, ImageDraw

    height, long = round(size * 2.6), 260
    sheet = Image.new("RGB", (width, height), PAPER)
    pen, letters = ImageDraw.Draw(sheet), font(size)
    text = "weight of a particle, over the mean weight:   1/10"
    pen.text((10, height / 2), text, fill=INK, font=letters, anchor="lm")
    left = int(10 + letters.getlength(text) + 10)
    ramp = (_WEIGHT(np.linspace(0, 1, long))[None, :, :3] * 255).astype(np.uint8).repeat(height // 2, 0)
    sheet.paste(Image.fromarray(ramp), (left, height // 4))
    pen.text((left + long + 10, height / 2), "10", fill=INK, font=letters, anchor="lm")
    return np.asarray(sheet)


def axes_legend() -> Sequence[tuple[str, tuple[int, int, int]]]:
    """Return the legend of the axes' colours."""
    return list(zip("xyz", AXES, strict=True))
