"""Draw the silhouettes of poses, and the weight that covers each pixel."""

import cv2
import numpy as np
import torch
from matplotlib import colormaps

from posefilter.figures.canvas import TRUTH, View, arrange_grid, close_up, full_view
from posefilter.figures.layout import CAPTION, compose_figure, draw_legend, draw_text, tile_width
from posefilter.figures.panels import draw_color_scale
from posefilter.figures.particles import (
    choose_by_weight,
    choose_steps,
    describe_step,
    fade,
    normalize_weights,
)
from posefilter.geometry.camera import project
from posefilter.geometry.pose import transform
from posefilter.types import Trace

_LINE = (255, 225, 120)


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
            placed = np.round(view.place(one)).clip(-16_000, 16_000).astype(np.int32)
            corners = cv2.convexHull(placed)
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
        weights = normalize_weights(trace.particles[number])
        poses = trace.outputs[number].pose[0].detach().cpu().double()
        chosen = poses[choose_by_weight(weights, 64)]
        pixels = project_hulls(chosen, hull, K)
        tiles = []
        for view, ground in zip((frame, near), grounds, strict=True):
            share = compute_coverage(pixels, np.full(len(pixels), 1 / len(pixels)), view)
            picture = blend_coverage(ground, share)
            view.outline(picture, outline_hulls(pixels[::4]), _LINE, 1, halo=False)
            view.outline(picture, outline_hulls(true), TRUTH, 2)
            tiles.append(picture)
        parts += [draw_text(describe_step(trace, number, "mm"), CAPTION), arrange_grid(tiles, 2)]
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
