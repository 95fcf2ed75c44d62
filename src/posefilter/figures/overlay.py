"""Draw poses onto a photograph: the object's outline, and its axes at its center."""

from collections.abc import Sequence
from functools import cache
from itertools import product
from typing import Any

import cv2
import numpy as np
from torch import Tensor

from posefilter.errors import UserError
from posefilter.figures.canvas import (
    AXES,
    ESTIMATE,
    TRUTH,
    Color,
    View,
    close_up,
    draw_dots,
    draw_lines,
    draw_row,
    full_view,
    split_dashes,
)
from posefilter.geometry.rigid import move
from posefilter.images import to_camera, to_picture, to_pose
from posefilter.meshes.mesh import Mesh
from posefilter.rendering.embree import EmbreeRenderer, render_depth
from posefilter.rendering.surfaces import project

Shape = Mesh | np.ndarray | Tensor  # a mesh, or the (V, 3) vertices of a convex hull [m]
WIDTH = 640  # [px] at least
_NEAR = 0.01  # [m]; what is nearer to the camera's plane is not drawn


def draw_overlay(
    rgb: Any,
    intrinsics: Any,
    pose: Any,
    shape: Shape,
    color: Color = ESTIMATE,
    truth: Any = None,
    caption: str = "",
    label: str = "estimate",
    width: int = WIDTH,
    dashed: bool = False,
) -> np.ndarray:
    """Draw where a pose puts the object, and where the truth does; caption and legend are on a row
    below the photograph.

    rgb: one image in any form that `Estimator.predict` takes; intrinsics (3, 3) [px]; pose, truth:
    (4, 4) camera_from_object [m], None where there is none; width: of the result at least [px];
    dashed: the pose is not sure. -> (s H + row, s W, 3) uint8, enlarged by s = max(1, width / W).
    Raises UserError where one is not as it should be.
    """
    rgb = to_picture(rgb)
    view = full_view(rgb.shape[0], rgb.shape[1], max(width, rgb.shape[1]))
    drawn = np.full((4, 4), np.nan) if pose is None else pose  # which draws nothing
    picture = draw_poses(rgb, intrinsics, drawn, shape, view, color, truth, dashed=dashed)
    entries = [] if truth is None else [("truth", TRUTH)]
    entries += [] if pose is None else [(label, color), *list_axes()]
    return np.concatenate([picture, draw_row(picture.shape[1], caption, entries)])


def draw_poses(
    rgb: Any,
    intrinsics: Any,
    pose: Any,
    shape: Shape,
    view: View | None = None,
    color: Color = ESTIMATE,
    truth: Any = None,
    coarse: int = 1,
    dashed: bool = False,
) -> np.ndarray:
    """Return the same without writing, of the part of the photograph that `view` shows: all of it,
    if None.

    coarse: pixels that a mesh's outline may miss its silhouette by; rays are cast that much more
    sparsely.
    """
    rgb = to_picture(rgb)
    view = view or full_view(rgb.shape[0], rgb.shape[1], max(WIDTH, rgb.shape[1]))
    picture = view.show(rgb)
    shown = view.camera(to_camera(intrinsics))
    if truth is not None:
        draw_pose(picture, shown, to_pose(truth), shape, TRUTH, coarse=coarse)
    draw_pose(picture, shown, to_pose(pose), shape, color, coarse=coarse, dashed=dashed)
    return picture


def view_poses(
    poses: Sequence[np.ndarray], shape: Shape, K: np.ndarray, height: int, width: int, shown: int
) -> View:
    """Return a close-up of where poses put the object; the whole frame where that is nowhere."""
    bounds = get_bounds(shape)
    corners = np.array(list(product(*bounds.T)))
    found = []
    for pose in poses:
        camera = move(corners, pose)
        if np.isfinite(camera).all() and (camera[:, 2] > _NEAR).all():
            pixels = project(camera, np.asarray(K, np.float64))
            found.append(np.clip(pixels, 0, [width - 1, height - 1]))
    if not found:
        return full_view(height, width, shown)
    return close_up(np.concatenate(found), height, width, shown, margin=0.12)


def list_axes() -> list[tuple[str, Color]]:
    """Return what the axes' colors mean."""
    return list(zip("xyz", AXES, strict=True))


def draw_pose(
    picture: np.ndarray,
    K: np.ndarray,
    pose: np.ndarray,
    shape: Shape,
    color: Color,
    width: int = 2,
    coarse: int = 1,
    dashed: bool = False,
) -> None:
    """Draw a pose's outline and axes into a picture, in place; of a dashed one the axes are thin.

    Poses that are not finite draw nothing.
    """
    if not np.isfinite(pose).all():
        return
    lines = outline_object(pose, shape, K, picture.shape[0], picture.shape[1], coarse)
    if dashed:
        lines = [one for line in lines for one in split_dashes(line, closed=True)]
    draw_lines(picture, lines, color, width, closed=not dashed)
    draw_axes(picture, K, pose, shape, color, 1 if dashed else width)


def draw_axes(
    picture: np.ndarray, K: np.ndarray, pose: np.ndarray, shape: Shape, color: Color, width: int = 2
) -> None:
    """Draw the object's axes at the center of its box: x red, y green, z blue, the farthest first;
    knobs in `color`.
    """
    low, high = get_bounds(shape)
    length = 0.3 * float(np.linalg.norm(high - low))
    ends = (low + high) / 2 + length * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    camera = move(ends, pose)
    if (camera[:, 2] < _NEAR).any():
        return
    pixels = project(camera, K)
    for axis in np.argsort(-camera[1:, 2]):
        draw_lines(picture, [pixels[[0, axis + 1]]], AXES[axis], width)
        draw_dots(picture, pixels[[axis + 1]], (0, 0, 0), width + 2)
        draw_dots(picture, pixels[[axis + 1]], color, width + 1)


def outline_object(
    pose: np.ndarray, shape: Shape, K: np.ndarray, height: int, width: int, coarse: int = 1
) -> list[np.ndarray]:
    """Return the closed lines round the object: a mesh's silhouette, or the projected hull.  ->
    each (P, 2) [px].
    """
    if isinstance(shape, Mesh):
        view = View(-0.5, -0.5, 1 / coarse, -(-width // coarse), -(-height // coarse))
        mask = render_silhouette(shape, pose, view.camera(K), view.height, view.width)
        found = trace_outline(mask)
        if coarse > 1:  # straight edges are no stairs
            found = [cv2.approxPolyDP(line, 0.7, closed=True)[:, 0] for line in found]
        return [(line + 0.5) * coarse - 0.5 for line in found]
    camera = _clip_to_front(move(get_vertices(shape), pose))
    if len(camera) < 3:
        return []
    return [cv2.convexHull(project(camera, K).astype(np.float32))[:, 0]]


def render_silhouette(
    mesh: Mesh, pose: np.ndarray, K: np.ndarray, height: int, width: int
) -> np.ndarray:
    """Return which pixels the mesh covers, were it alone in the frame.  -> (H, W) bool."""
    depth, _ = render_depth([mesh], [pose], K, height, width, _renderer())
    return depth > 0


def trace_outline(mask: np.ndarray) -> list[np.ndarray]:
    """Return the closed lines through the outermost pixels of a mask, and of its holes.

    (H, W) bool -> each (P, 2) [px].
    """
    found: Sequence[np.ndarray] = cv2.findContours(
        mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE
    )[0]
    return [line[:, 0] for line in found]


def get_vertices(shape: Shape) -> np.ndarray:
    """Return the points that bound the object.  -> (V, 3) [m]."""
    if isinstance(shape, Mesh):
        return shape.vertices
    vertices = shape.detach().cpu().numpy() if isinstance(shape, Tensor) else shape
    if not isinstance(vertices, np.ndarray) or vertices.ndim != 2 or vertices.shape[1] != 3:
        raise UserError(
            f"shape: is {type(shape).__name__}; expected a mesh, or the vertices of a hull (V, 3) "
            "[m], such as result.object_model.hull"
        )
    return vertices.astype(np.float64)


def get_bounds(shape: Shape) -> np.ndarray:
    """Return the least and greatest corners of the object's box.  -> (2, 3) [m]."""
    if isinstance(shape, Mesh):
        return shape.bounds
    return np.stack([get_vertices(shape).min(0), get_vertices(shape).max(0)])


def _clip_to_front(points: np.ndarray) -> np.ndarray:
    """Cut the convex hull of camera points (V, 3) [m] at the near plane: those before it, and where
    edges pierce it.
    """
    before = points[:, 2] >= _NEAR
    if before.all():
        return points
    a, b = points[before][:, None], points[~before][None]
    share = (a[..., 2:] - _NEAR) / (a[..., 2:] - b[..., 2:])
    return np.concatenate([points[before], (a + share * (b - a)).reshape(-1, 3)])


@cache
def _renderer() -> EmbreeRenderer:
    return EmbreeRenderer(keep=8)
