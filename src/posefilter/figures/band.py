"""Draw how sure a belief is of the object's outline: a band on the photograph.

Each pose of a belief puts a silhouette on the image, so that each pixel has a probability to be
covered.  In the band are the pixels at which that is neither nearly 0 nor nearly 1.  Going outward
through a point of the outline, the silhouettes end at places that the belief has a distribution of,
and the band is the central interval of these: it holds the outline pointwise, not as a whole.
"""

from typing import Any

import cv2
import numpy as np
import torch

from posefilter.figures.canvas import ESTIMATE, Color, View, draw_lines, draw_row, full_view
from posefilter.figures.overlay import WIDTH, Shape, get_vertices, render_silhouette, trace_outline
from posefilter.figures.particles import choose_by_weight
from posefilter.figures.silhouettes import compute_coverage, project_hulls
from posefilter.images import to_camera, to_picture
from posefilter.meshes.mesh import Mesh

_DRAWN = 200  # silhouettes of a hull, which cost little
_RENDERED = 60  # of a mesh
_BAND: Color = (255, 200, 40)
_OPACITY = 0.45


def measure_cover(
    poses: np.ndarray, weights: np.ndarray, shape: Shape, K: np.ndarray, view: View
) -> np.ndarray:
    """Return each shown pixel's probability to be covered by the object.

    Silhouettes are of poses chosen by weight: 200 of a hull, 60 of a mesh.  Poses that lie behind
    the camera cover nothing.

    Args:
        poses: (N, 4, 4) camera_from_object [m].
        weights: (N,) that sum to 1.
        shape: A mesh, or the vertices of a convex hull.
        K: (3, 3) [px] of the photograph.
        view: What is shown of it.

    Returns:
        (h, w) float32 in [0, 1].
    """
    count = _RENDERED if isinstance(shape, Mesh) else _DRAWN
    share = torch.from_numpy(weights / weights.sum())
    chosen = poses[choose_by_weight(share, count).numpy()]
    shown = view.camera(K)
    if isinstance(shape, Mesh):
        size = (view.height, view.width)
        layers = [render_silhouette(shape, pose, shown, *size) for pose in chosen]
        return np.asarray(np.mean(layers, axis=0, dtype=np.float32))
    hull = torch.from_numpy(get_vertices(shape)).double()
    pixels = project_hulls(torch.from_numpy(chosen).double(), hull, np.asarray(K, np.float64))
    return compute_coverage(pixels, np.full(count, 1 / count), view)


def find_band(cover: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what the object covers surely, and what it may cover: the band lies between them.

    Args:
        cover: (h, w) probabilities to be covered.
        level: Probability that the outline lies in the band, at a point of it.

    Returns:
        (h, w) bool each; the first is a part of the second.
    """
    rest = (1 - level) / 2
    return cover > 1 - rest, cover > rest


def draw_band(
    rgb: Any,
    intrinsics: Any,
    poses: np.ndarray,
    weights: np.ndarray,
    shape: Shape,
    level: float = 0.95,
    caption: str = "",
) -> np.ndarray:
    """Draw the band of a belief on the photograph, and the outline at which half of it ends.

    Args:
        rgb: One image, in any form that `Estimator.predict` takes.
        intrinsics: Its camera matrix (3, 3) [px].
        poses: (N, 4, 4) camera_from_object [m].
        weights: (N,) that sum to 1.
        shape: A mesh, or the vertices of a convex hull.
        level: Probability that the outline lies in the band, at a point of it.
        caption: Written below.

    Returns:
        The picture (h, w, 3) uint8.

    Raises:
        UserError: The image or the camera matrix is not as it should be.
    """
    rgb, K = to_picture(rgb), to_camera(intrinsics)
    view = full_view(rgb.shape[0], rgb.shape[1], max(WIDTH, rgb.shape[1]))
    picture = view.show(rgb)
    cover = measure_cover(poses, weights, shape, K, view)
    surely, maybe = find_band(cover, level)
    band = maybe & ~surely
    picture[band] = (
        (1 - _OPACITY) * picture[band] + _OPACITY * np.array(_BAND, np.float32)
    ).round()
    for part in (surely, maybe):
        draw_lines(picture, trace_outline(part), _BAND, 1, closed=True, halo=False)
    smooth = cv2.GaussianBlur(cover, (3, 3), 0)  # without single pixels' steps
    draw_lines(picture, trace_outline(smooth > 0.5), ESTIMATE, 1, closed=True, halo=False)
    entries = [("outline", ESTIMATE), (f"{100 * level:g} % band", _BAND)]
    return np.concatenate([picture, draw_row(picture.shape[1], caption, entries)])
