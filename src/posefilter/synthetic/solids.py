"""The geometry of a mesh that placing needs: convex hull, bounding sphere, stable rotations."""

from dataclasses import dataclass

import cv2
import numpy as np

from posefilter.geometry.rotation import fibonacci_sphere
from posefilter.meshes.mesh import Mesh
from posefilter.rendering.surfaces import project

_OWN = 0.26  # [rad] a rest that is no farther from the mesh's own is the own


@dataclass(frozen=True, eq=False)
class Solid:
    """A mesh, its convex hull, and the rotations in which it lies stably on a table."""

    mesh: Mesh
    hull: np.ndarray  # (V, 3) the vertices that reach farthest in 300 directions [m]
    center: np.ndarray  # (3,) of the bounding box [m]
    radius: float  # of the hull around the center [m]
    stable_rotations: np.ndarray  # (R, 3, 3) table_from_object rotations in which it rests, z up
    stable_weights: np.ndarray  # (R,) how likely each is when dropped, sums to 1


def make_solid(mesh: Mesh) -> Solid:
    """Compute the hull, the bounding sphere and the stable rotations of a mesh."""
    hull = mesh.vertices[np.unique((fibonacci_sphere(300) @ mesh.vertices.T).argmax(1))]
    center = mesh.bounds.mean(0)
    radius = float(np.linalg.norm(hull - center, axis=1).max())
    return Solid(mesh, hull, center, radius, *find_stable_rotations(hull))


def find_stable_rotations(hull: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the rotations in which a convex body lies stably.

    They are local minima of the height of the center of mass (taken as the center of the box) over
    all directions that could point down. Directions from all over the sphere descend to them. What
    stands on a small foot is seldom found so, and therefore its own -z descends besides, by smaller
    steps.

    Args:
        hull: (V, 3) vertices [m].

    Returns:
        Rotations (R, 3, 3) that turn the direction of each minimum down, and the fraction of the
        directions that ended there (R,).
    """
    directions = 200
    body = hull - (hull.min(0) + hull.max(0)) / 2
    down = _descend(fibonacci_sphere(directions), body, 0.2)
    ends, counts = [down[0]], [0]
    for d in down:
        near = np.stack(ends) @ d
        if near.max() > np.cos(0.06):
            counts[int(near.argmax())] += 1
        else:
            ends.append(d)
            counts.append(1)
    weights = np.array(counts, float)
    keep = weights > 0.01 * directions
    found, weights = np.stack(ends)[keep], weights[keep]
    own = _descend(np.array([[0.0, 0.0, -1.0]]), body, 0.03)
    if -own[0, 2] > np.cos(_OWN) and (found @ own[0]).max() <= np.cos(_OWN):
        found, weights = np.concatenate([found, own]), np.append(weights, 0.01 * directions)
    return np.stack([rotation_down(d) for d in found]), weights / weights.sum()


def _descend(down: np.ndarray, body: np.ndarray, first: float) -> np.ndarray:
    """Move directions to where the body's middle is lower, by smaller and smaller random steps.

    Args:
        down: (N, 3) unit directions.
        body: (V, 3) vertices about the middle [m].
        first: Standard deviation of the first steps [rad].

    Returns:
        (N, 3) unit directions.
    """
    rng = np.random.default_rng(0)
    for spread in np.geomspace(first, 0.001, 32):
        trial = down[:, None] + spread * rng.standard_normal((1, 12, 3))
        trial /= np.linalg.norm(trial, axis=-1, keepdims=True)
        trial = np.concatenate([down[:, None], trial], 1)
        down = trial[np.arange(len(down)), (trial @ body.T).max(-1).argmin(1)]
    return down


def rotation_down(direction: np.ndarray) -> np.ndarray:
    """Return the smallest rotation that takes a unit direction to -z.  (3,) -> (3, 3)."""
    target = np.array([0.0, 0.0, -1.0])
    axis, cosine = np.cross(direction, target), float(direction @ target)
    if cosine < -0.999999:
        return np.diag([1.0, -1.0, -1.0])
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + K + K @ K / (1 + cosine)


_DIRECTIONS = fibonacci_sphere(160)


def separated(a: np.ndarray, b: np.ndarray, gap: float = 0.0) -> bool:
    """Return whether some plane separates two point sets by `gap` [m].  (P, 3), (Q, 3).

    160 spread directions and the line of centers are tried. False may be wrong for bodies that
    nearly touch; True is exact.
    """
    between = b.mean(0) - a.mean(0)
    d = np.concatenate([_DIRECTIONS, [between / (np.linalg.norm(between) + 1e-12)]])
    da, db = a @ d.T, b @ d.T
    return bool(((db.min(0) - da.max(0) > gap) | (da.min(0) - db.max(0) > gap)).any())


def outline_mask(
    points: np.ndarray, K: np.ndarray, height: int, width: int, stride: int
) -> np.ndarray:
    """Return the mask of a convex body.

    Args:
        points: (P, 3) in the camera [m], all in front of it.
        K: (3, 3) camera matrix [px].
        height: Of the image [px].
        width: Of the image [px].
        stride: Every stride-th pixel is computed.

    Returns:
        (height // stride, width // stride) bool.
    """
    pixels = np.clip(project(points, K) / stride, -2000, 2000)
    mask = np.zeros((height // stride, width // stride), np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(np.round(pixels * 16).astype(np.int32)), 1, shift=4)
    return mask > 0
