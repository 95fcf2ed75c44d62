"""Draw particles on the image, colored by weight: one step, or a row of steps over the
filter's run.
"""

import math

import cv2
import numpy as np
import torch
from matplotlib import colormaps

from posefilter.figures.canvas import (
    AXES,
    View,
    arrange_grid,
    close_up,
    draw_dots,
    draw_lines,
    full_view,
    halve,
)
from posefilter.figures.layout import (
    CAPTION,
    add_caption,
    compose_figure,
    draw_legend,
    draw_scale,
    draw_text,
    tile_width,
)
from posefilter.figures.overlay import list_axes
from posefilter.figures.panels import map_colors
from posefilter.geometry.camera import project
from posefilter.geometry.lookup import is_off_frame
from posefilter.geometry.pose import origin_of
from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Space
from posefilter.types import Particles, Trace

_REACH = 10.0  # the colors span weights from 1 / _REACH to _REACH times the mean


def color_by_weight(weights: np.ndarray) -> np.ndarray:
    """Return colors by weight over the mean weight, logarithmic, the same scale in every picture.

    (N,) -> (N, 3) uint8.
    """
    ratio = np.maximum(weights * len(weights), 1e-12)
    level = np.clip((np.log(ratio) / math.log(_REACH) + 1) / 2, 0, 1)
    return map_colors(level, 0, 1, "plasma")


def draw_particles(
    rgb: np.ndarray, pixels: np.ndarray, weights: np.ndarray, view: View
) -> np.ndarray:
    """Draw particles on a faded photograph, the heaviest on top.

    rgb (H, W, 3) uint8; pixels (N, 2) [px]; weights (N,) summing to 1. -> (view.height, view.width,
    3) uint8.
    """
    return draw_particles_on(draw_background(rgb, view), pixels, weights, view)


def draw_background(rgb: np.ndarray, view: View) -> np.ndarray:
    """Return the faded photograph that particles are drawn on, at twice the size: OpenCV's smallest
    discs are no discs.
    """
    return view.finer(2).show(fade(rgb, 0.4))


def draw_particles_on(
    below: np.ndarray,
    pixels: np.ndarray,
    weights: np.ndarray,
    view: View,
    axes: np.ndarray | None = None,
) -> np.ndarray:
    """Draw the same on a background that is there already.

    axes (M, 4, 2) [px]: center and the ends of x, y and z of the poses whose axes are drawn.
    """
    fine, picture = view.finer(2), below.copy()
    if axes is not None:
        draw_many_axes(picture, fine.place(axes))
    order = np.argsort(weights, kind="stable")
    colors, radius = color_by_weight(weights)[order], max(3.0, fine.width / 200)
    draw_dots(picture, fine.place(pixels[order]), colors, radius)
    return halve(picture)


def fade(rgb: np.ndarray, share: float) -> np.ndarray:
    """Return a picture mixed with its own gray, darkened, so that colors drawn on it show."""
    mix = (1 - share) * np.eye(3) + share / 3
    return np.asarray(cv2.transform(rgb, (1 - 0.5 * share) * mix))


def draw_many_axes(picture: np.ndarray, axes: np.ndarray, opacity: float = 0.6) -> None:
    """Draw the axes of several poses, half transparent, in place.  (M, 4, 2) [px]."""
    layer = picture.copy()
    for k, color in enumerate(AXES, start=1):
        draw_lines(layer, list(axes[:, [0, k]]), color, 2, halo=False)
    cv2.addWeighted(layer, opacity, picture, 1 - opacity, 0, picture)


def project_axes(
    poses: torch.Tensor, center: torch.Tensor, length: float, K: torch.Tensor
) -> np.ndarray:
    """Return where poses put the center and the ends of the axes.

    (M, 4, 4), (3,) [m], (3, 3) -> (M, 4, 2) [px].
    """
    ends = center + length * torch.cat([torch.zeros(1, 3), torch.eye(3)]).to(center)
    return project(torch.stack([origin_of(poses, end) for end in ends], dim=1), K).numpy()


def draw_iterations(
    rgb: np.ndarray, K: np.ndarray, trace: Trace, space: Space, title: str = ""
) -> np.ndarray:
    """Draw the particles of one image at several of the filter's steps, the first and the last
    included.

    rgb (H, W, 3) uint8; K (3, 3) [px]; trace: of the image alone. Particles in pixel space are
    dots, at eight steps. Those in pose space are dots at the object's center, with the axes of a
    few drawn by weight, at four steps: on the whole photograph, and beside it on a close-up of the
    object, since the last particles lie too close to be seen otherwise.
    """
    height, wide = rgb.shape[:2]
    width = tile_width(2)
    frame = full_view(height, wide, width)
    parts: list[np.ndarray] = []
    if isinstance(space, PoseSpace):
        steps = [
            PoseStep(K, trace, number, space) for number in choose_steps(len(trace.particles), 4)
        ]
        views = (frame, close_up(steps[-1].extent(), height, wide, width, margin=0.1))
        grounds = [draw_background(rgb, view) for view in views]
        for one in steps:
            tiles = [one.draw(below, view) for below, view in zip(grounds, views, strict=True)]
            parts += [draw_text(one.caption, CAPTION), arrange_grid(tiles, 2)]
        parts.append(draw_legend(list_axes()))
    else:
        below, tiles = draw_background(rgb, frame), []
        for number in choose_steps(len(trace.particles), 8):
            particles = trace.particles[number]
            state = particles.state[0].detach().cpu().numpy()
            off = measure_off_frame(state, height, wide)
            beyond = f", {off:.0%} off the frame" if off else ""
            note = describe_effective(particles) + beyond
            caption = f"step {number}: {describe_noise(trace, number, 'px')}"
            picture = draw_particles_on(below, state, normalize_weights(particles).numpy(), frame)
            tiles.append(add_caption(picture, caption, note=note))
        parts.append(arrange_grid(tiles, 2))
    return compose_figure(title or "Particles by iteration", *parts, draw_weight_scale())


def measure_off_frame(pixels: np.ndarray, height: int, width: int) -> float:
    """Return the share of places (N, 2) [px] that lie beyond the frame's edges."""
    return float(is_off_frame(torch.from_numpy(pixels), width, height).double().mean())


def describe_step(trace: Trace, number: int, unit: str) -> str:
    """Tell which step it is, its noise level, and how many particles are effective."""
    noise = describe_noise(trace, number, unit)
    return f"step {number}: {noise}, {describe_effective(trace.particles[number])}"


def describe_noise(trace: Trace, number: int, unit: str) -> str:
    """Tell a step's noise level, in mm of what is kept in meters, or in px."""
    sigma = trace.steps[number].sigma
    level = float(sigma.reshape(-1)[0]) * (1000 if unit == "mm" else 1)
    return f"noise {level:.3g} {unit}"


def describe_effective(particles: Particles) -> str:
    """Tell the effective share of one image's particles."""
    weights = normalize_weights(particles)
    return f"{float(1 / weights.square().sum() / len(weights)):.0%} effective"


def normalize_weights(particles: Particles) -> torch.Tensor:
    """Return one image's weights, summing to 1.  -> (N,) float64."""
    return torch.softmax(particles.log_weights[0].detach().cpu().double(), 0)


def choose_steps(count: int, max_steps: int) -> list[int]:
    """Return at most `max_steps` of `count` steps, evenly spread, the first and the last among
    them.
    """
    return sorted({round(x) for x in np.linspace(0, count - 1, min(max_steps, count)).tolist()})


class PoseStep:
    """One step of a filter whose particles are poses, projected."""

    def __init__(self, K: np.ndarray, trace: Trace, number: int, space: PoseSpace) -> None:
        camera = torch.as_tensor(np.asarray(K), dtype=torch.float64)
        center = torch.tensor(space.center, dtype=torch.float64)
        poses = trace.outputs[number].pose[0].detach().cpu().double()
        weights = normalize_weights(trace.particles[number])
        self.weights = weights.numpy()
        centers, few = origin_of(poses, center), poses[choose_by_weight(weights, 24)]
        self.pixels = project(centers, camera).numpy()
        self.axes = project_axes(few, center, 0.6 * space.radius, camera)
        away = max(float(weights @ centers[:, 2]), 0.05)
        self.half_side = space.radius * float(camera[0, 0]) / away
        self.caption = describe_step(trace, number, "mm")

    def extent(self) -> np.ndarray:
        """Return two corners that hold the object, as the mean of the particles has it.  -> (2, 2)
        [px].
        """
        middle = self.weights @ self.pixels
        return np.stack([middle - 0.7 * self.half_side, middle + 0.7 * self.half_side])

    def draw(self, below: np.ndarray, view: View) -> np.ndarray:
        """Draw it on a view's background."""
        return draw_particles_on(below, self.pixels, self.weights, view, self.axes)


def choose_by_weight(weights: torch.Tensor, count: int) -> torch.Tensor:
    """Choose particles by weight, without a random draw: systematic, from the middle of each share.

    (N,) -> (count,).
    """
    at = (torch.arange(count, dtype=weights.dtype) + 0.5) / count
    return torch.searchsorted(weights.cumsum(0), at).clamp(max=len(weights) - 1)


def draw_weight_scale() -> np.ndarray:
    """Return a row that explains the colors."""
    ramp = (colormaps["plasma"](np.linspace(0, 1, 256))[:, :3] * 255).astype(np.uint8)
    return draw_scale("weight: mean / 10", ramp, "x 10")
