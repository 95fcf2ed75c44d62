"""Objects as things that rest, touch and hide: what a scene's layout needs to know of a mesh."""

from dataclasses import dataclass

import cv2
import numpy as np

from posefilter.meshes.mesh import Mesh


@dataclass(frozen=True, eq=False)
class Solid:
    """A mesh, its convex hull, and how it can lie on a table."""

    mesh: Mesh
    hull: np.ndarray  # (V, 3) the vertices that reach farthest in 300 directions [m]
    center: np.ndarray  # (3,) of the bounding box [m]
    radius: float  # of the hull round the center [m]
    stable_rotations: np.ndarray  # (R, 3, 3) table_from_object rotations in which it rests, z up
    stable_weights: np.ndarray  # (R,) how likely each is when dropped, sums to 1


def make_solid(mesh: Mesh) -> Solid:
    """Measure a mesh."""
    hull = mesh.vertices[np.unique((fibonacci_sphere(300) @ mesh.vertices.T).argmax(1))]
    center = mesh.bounds.mean(0)
    rests, weights = find_stable_rotations(hull)
    return Solid(
        mesh, hull, center, float(np.linalg.norm(hull - center, axis=1).max()), rests, weights
    )


def find_stable_rotations(hull: np.ndarray, directions: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Find how a convex body lies still.  (V, 3) -> rotations (R, 3, 3) that turn a resting
    direction down, weights (R,).

    Its center of mass (taken as the middle of its box) is lowest there: a local minimum of the
    height over the directions that could point down. From all over the sphere directions roll
    downhill; the share that ends in a minimum is its weight.
    """
    down = fibonacci_sphere(directions)
    body = hull - (hull.min(0) + hull.max(0)) / 2
    rng = np.random.default_rng(0)
    for spread in np.geomspace(0.2, 0.001, 32):
        trial = down[:, None] + spread * rng.standard_normal((1, 12, 3))
        trial = np.concatenate(
            [down[:, None], trial / np.linalg.norm(trial, axis=-1, keepdims=True)], 1
        )
        down = trial[np.arange(directions), (trial @ body.T).max(-1).argmin(1)]
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
    return np.stack([rotation_down(d) for d in np.stack(ends)[keep]]), weights[keep] / weights[
        keep
    ].sum()


def rotation_down(direction: np.ndarray) -> np.ndarray:
    """Return the least rotation that takes a unit direction to -z.  (3,) -> (3, 3)."""
    target = np.array([0.0, 0.0, -1.0])
    axis, cosine = np.cross(direction, target), float(direction @ target)
    if cosine < -0.999999:
        return np.diag([1.0, -1.0, -1.0])
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + K + K @ K / (1 + cosine)


def fibonacci_sphere(count: int) -> np.ndarray:
    """Return directions spread evenly.  -> (count, 3) unit."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], 1)


_DIRECTIONS = fibonacci_sphere(160)


def separated(a: np.ndarray, b: np.ndarray, gap: float = 0.0) -> bool:
    """Tell whether some plane keeps two point sets apart by `gap` [m].  (P, 3), (Q, 3).

    Directions tried: 160 spread ones and the line of centers. A no may be wrong for bodies that
    nearly touch, a yes is not.
    """
    between = b.mean(0) - a.mean(0)
    d = np.concatenate([_DIRECTIONS, [between / (np.linalg.norm(between) + 1e-12)]])
    da, db = a @ d.T, b @ d.T
    return bool(((db.min(0) - da.max(0) > gap) | (da.min(0) - db.max(0) > gap)).any())


def outline_mask(
    points: np.ndarray, K: np.ndarray, height: int, width: int, stride: int
) -> np.ndarray:
    """Return the mask of a convex body on a grid of every stride-th pixel.

    (P, 3) camera [m], all before it -> bool.
    """
    pixels = points[:, :2] / points[:, 2:] * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]
    pixels = np.clip(pixels / stride, -2000, 2000)
    mask = np.zeros((height // stride, width // stride), np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(np.round(pixels * 16).astype(np.int32)), 1, shift=4)
    return mask > 0
