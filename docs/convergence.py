"""An animation that is good to look at: poses that close in on the object, from blank
to certain.
"""

from collections.abc import Iterator, Sequence
from io import BytesIO
from typing import NamedTuple

import cv2
import numpy as np
import torch
from PIL import Image, ImageDraw

from posefilter.figures.canvas import ESTIMATE, View, draw_lines, full_view, load_font
from posefilter.figures.overlay import Shape, draw_pose
from posefilter.figures.particles import choose_by_weight, color_by_weight, normalize_weights
from posefilter.figures.silhouettes import outline_hulls, project_hulls
from posefilter.geometry.pose import origin_of, pose_about, rotation_of
from posefilter.geometry.rotation import exp_so3, log_so3
from posefilter.types import Trace

# outlines that are drawn over each other rather than added: a layer each would take long
_GROUP = 6
_BAR = 44  # [px] below the photograph
_DARK = (24, 27, 34)
_LIGHT = (226, 230, 238)
_SOFT = (120, 128, 142)


class Keyframe(NamedTuple):
    """Some particles of one iteration, and where their ancestors were at the one before.

    The first has the particles that the filter begins with, before anything is known of it.
    """

    before: torch.Tensor  # (n, 4, 4)
    after: torch.Tensor  # (n, 4, 4)
    colors: np.ndarray  # (n, 3) uint8, by weight


def animate_convergence(
    rgb: np.ndarray,
    K: np.ndarray,
    trace: Trace,
    center: torch.Tensor,
    hull: torch.Tensor,
    shape: Shape,
    width: int = 640,
    count: int = 120,
    between: int = 6,
    hold: int = 20,
) -> Iterator[np.ndarray]:
    """Yield the frames of an animation of one image's particles, which are poses.

    Args:
        rgb: Photograph (H, W, 3) uint8.
        K: Camera matrix (3, 3) [px].
        trace: The filter's run on this image alone.
        center: The object's center (3,) in its own frame [m].
        hull: The object's convex hull (V, 3) [m].
        shape: What the estimate is outlined with.
        width: Of the frames [px].
        count: How many particles are drawn, chosen by weight.
        between: Frames from one iteration to the next.
        hold: Frames at the end that show the estimate.

    Yields:
        Frames (height, width, 3) uint8, all of one size.
    """
    view = full_view(rgb.shape[0], rgb.shape[1], width)
    photograph = smooth_enlarge(rgb, view)
    ground = cv2.addWeighted(photograph, 0.6, np.full_like(photograph, 18), 0.4, 0)
    keys = choose_keyframes(trace, count)
    for number, key in enumerate(keys):
        words = f"iteration {number} of {len(keys) - 1}" if number else "anywhere on the scene"
        for step in range(between):
            share = ease((step + 1) / between)
            poses = interpolate_poses(key.before, key.after, share, center)
            done = (number - 1 + (step + 1) / between) / (len(keys) - 1) if number else 0.0
            yield add_bar(draw_glow(ground, poses, key.colors, hull, K, view), words, done)
    best = trace.belief.best[0].detach().cpu().double().numpy()
    last = draw_glow(ground, keys[-1].after, keys[-1].colors, hull, K, view)
    found = photograph.copy()
    draw_pose(found, view.camera(K), best, shape, ESTIMATE, width=3)
    for step in range(hold):
        share = ease(min(1.0, (step + 1) / min(8, hold)))
        yield add_bar(cv2.addWeighted(found, share, last, 1 - share, 0), "the pose found", 1.0)


def choose_keyframes(trace: Trace, count: int) -> list[Keyframe]:
    """Return some particles of each iteration, chosen by weight, with their ancestors; of the first
    iteration any of them.
    """
    first = trace.particles[0].state[0].detach().cpu().double()
    some = first[torch.linspace(0, len(first) - 1, count).long()]
    out = [Keyframe(some, some, color_by_weight(np.full(count, 1 / count)))]
    for before, particles in zip(trace.particles, trace.particles[1:], strict=False):
        weights = normalize_weights(particles)
        few = choose_by_weight(weights, count)
        few = few[weights[few].argsort(stable=True)]
        after = particles.state[0].detach().cpu().double()[few]
        ancestors = before.state[0].detach().cpu().double()[particles.ancestors[0].cpu()[few]]
        out.append(Keyframe(ancestors, after, color_by_weight(weights.numpy())[few.numpy()]))
    return out


def interpolate_poses(
    before: torch.Tensor, after: torch.Tensor, share: float, center: torch.Tensor
) -> torch.Tensor:
    """Return poses between two, along the shortest turn about the object's center.

    (n, 4, 4) twice -> (n, 4, 4).
    """
    start, end = rotation_of(before), rotation_of(after)
    rotation = start @ exp_so3(share * log_so3(start.mT @ end))
    center = center.to(before)
    place = torch.lerp(origin_of(before, center), origin_of(after, center), share)
    return pose_about(rotation, place, center)


def ease(share: float) -> float:
    """Return a share of the way that begins and ends slowly."""
    return share * share * (3 - 2 * share)


def smooth_enlarge(rgb: np.ndarray, view: View) -> np.ndarray:
    """Return the photograph at the view's size, its sensor noise taken out: it would flicker, and
    cost bytes.
    """
    calm = cv2.fastNlMeansDenoisingColored(rgb, None, 6, 6, 5, 15)
    return view.show(np.asarray(calm))


def draw_glow(
    ground: np.ndarray,
    poses: torch.Tensor,
    colors: np.ndarray,
    hull: torch.Tensor,
    K: np.ndarray,
    view: View,
) -> np.ndarray:
    """Draw poses as translucent outlines: where many agree, they shine."""
    glow = np.zeros(ground.shape, np.float32)
    pixels = project_hulls(poses, hull, K)
    for group in np.array_split(np.arange(len(poses)), max(1, len(poses) // _GROUP)):
        layer = np.zeros_like(ground)
        for i in group:
            lines = [view.place(line) for line in outline_hulls(pixels[i : i + 1])]
            draw_lines(layer, lines, (*colors[i].tolist(),), 1, closed=True, halo=False)
        glow += layer
    glow = 255 * (1 - np.exp(-glow / 255 * 0.6))
    shade = 1 - 0.7 * glow.max(-1, keepdims=True) / 255
    return np.asarray(np.clip(ground * shade + glow, 0, 255).astype(np.uint8))


def add_bar(frame: np.ndarray, words: str, share: float) -> np.ndarray:
    """Return a frame with a bar below it: what is seen, and how far the filter is."""
    width = frame.shape[1]
    image = Image.new("RGB", (width, _BAR), _DARK)
    pen = ImageDraw.Draw(image)
    pen.text((16, _BAR / 2), words, fill=_LIGHT, font=load_font(18), anchor="lm")
    left, right = width * 0.42, width - 16.0
    pen.line([(left, _BAR / 2), (right, _BAR / 2)], fill=_SOFT, width=2)
    pen.line([(left, _BAR / 2), (left + (right - left) * share, _BAR / 2)], fill=ESTIMATE, width=4)
    return np.concatenate([frame, np.asarray(image)])


def encode_webp(
    frames: Sequence[np.ndarray], milliseconds: int = 60, last: int = 1500, quality: int = 60
) -> bytes:
    """Return frames as an animated WebP that loops; the last one is held."""
    images = [Image.fromarray(frame) for frame in frames]
    durations = [milliseconds] * (len(images) - 1) + [last]
    stream = BytesIO()
    images[0].save(
        stream,
        "WEBP",
        save_all=True,
        append_images=images[1:],
        duration=durations,
        loop=0,
        quality=quality,
        method=4,
    )
    return stream.getvalue()
