"""Whether two objects are so alike that an image may not tell them apart."""

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from posefilter.meshes.mesh import Mesh, sample_surface, surface_colors

_SIDES = 0.2  # of the bounding boxes' sides, in order of length: largest difference of logarithms
_FILL = 0.2  # of the shares of these boxes that the convex hulls fill
_COLOR = 0.15  # between mean colors without brightness
_DARK = 0.15  # added to a color's sum: of a dark surface the hue is not seen
_POINTS = 2000


def are_alike(one: Mesh, other: Mesh) -> bool:
    """Tell whether two objects are alike in size, shape and color, whatever is printed on them.

    A network that learns to tell its object from such another one, as clutter in its training,
    learns to reject the object itself in images that show too little of it.
    """
    sides, others = (np.log(np.sort(m.bounds[1] - m.bounds[0]) + 1e-9) for m in (one, other))
    if np.abs(sides - others).max() > _SIDES or abs(_fill(one) - _fill(other)) > _FILL:
        return False
    return float(np.linalg.norm(_mean_color(one) - _mean_color(other))) <= _COLOR


def _fill(mesh: Mesh) -> float:
    """Return the share of its bounding box that a mesh's convex hull fills; 1 where it is flat."""
    try:
        return float(ConvexHull(mesh.vertices).volume / np.prod(mesh.bounds[1] - mesh.bounds[0]))
    except QhullError:
        return 1.0


def _mean_color(mesh: Mesh) -> np.ndarray:
    """Return the mean color (3,) of a surface, without its brightness."""
    colors = surface_colors(mesh, *sample_surface(mesh, _POINTS))
    mean: np.ndarray = (colors / (colors.sum(1, keepdims=True) + _DARK)).mean(0)
    return mean
