"""Find an object's symmetries: turns that move its surface, and its texture, onto themselves.

Candidate axes are the principal axes of the surface, the axes of its smallest oriented box, and two
directions that every turn of it keeps: a cone about as wide as high has no other axis.  The
principal axes of a solid with several axes of third turns, such as an octahedron, are arbitrary:
then the directions of its large flat faces are tried, too.
About each, turns by a half, a third and a quarter are tried, and some by angles that divide no
circle, which stand for any turn.  A turn is first refined by registering the turned surface with
itself, since a scan's axes are not exact, and is then judged by distances of turned surface samples
to the nearest of a second, denser sampling.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree

from posefilter.geometry.rigid import move
from posefilter.geometry.rotation import log_so3
from posefilter.meshes.mesh import (
    Mesh,
    diameter,
    face_normals,
    hull_vertices,
    sample_surface,
    surface_colors,
    surface_points,
)
from posefilter.meshes.rotational_symmetries import ANY, RotationalSymmetry
from posefilter.meshes.symmetries import are_parallel, rotation_about

FOLDS = (2, 3, 4, 5)
# Allowed beyond what two samplings of one surface differ by, in diameters: of the mean distance,
# and of the distance that a fiftieth of the samples exceed, which holes and handles raise.
MEAN_EXCESS, FAR_EXCESS = 0.01, 0.02
# of the color difference, in [0, 1], that a twentieth of the samples exceed
MOST_COLOR = 0.18
_SAMPLES, _DENSE = 3000, 20000
_ANY_ANGLES = tuple(2 * np.pi * k * 0.381966 for k in (1, 2, 3))  # by the golden angle
_LEAST_MOMENT = 0.01  # of the mean (cubed) distance; what samples of a symmetric shape stay below
_ALIKE = 0.9  # the smallest standard deviation by the largest, of a solid without principal axes
# of the hull's area, what two opposite faces have at least, of an icosahedron a tenth; normals of a
# face, measured, are within 5 degrees
_LEAST_FACE, _ONE_FACE = 0.04, np.cos(np.deg2rad(5.0))
_MOST_TRIANGLES = 200  # that are looked at, the largest first
_COARSE = 0.03  # [diameters] a candidate that is farther off before its refinement is none


class _Surface(NamedTuple):
    """Samples of a surface, and denser ones to which they are compared."""

    points: np.ndarray  # (P, 3) [m]
    normals: np.ndarray  # (P, 3), times a length: far apart for the two sides of a thin wall
    dense: np.ndarray  # (D, 3) [m]
    nearest: cKDTree  # of the dense points
    nearest_side: cKDTree  # of the dense points with their normals
    dense_colors: np.ndarray  # (D, 3)
    colors: np.ndarray  # (P, 3), smoothed
    diameter: float


def find_symmetries(mesh: Mesh) -> list[RotationalSymmetry]:
    """Return the turns that leave the shape of a mesh as it is; of each, whether the texture too.

    The best are first; `rotational_symmetries.select` takes a group's generators from them.
    """
    surface = _sample(mesh)
    center = surface.points.mean(0)  # every symmetry leaves the centroid as it is
    found: list[RotationalSymmetry] = []
    for axis in _candidate_axes(mesh, surface):
        for fold in (ANY, *FOLDS):
            turn = _try(surface, axis, center, fold)
            if turn is not None and turn.shape:
                found.append(turn)
    found.sort(key=lambda turn: turn.distance)
    kept: list[RotationalSymmetry] = []
    for turn in found:
        if not any(turn.fold == k.fold and are_parallel(turn.axis, k.axis) for k in kept):
            kept.append(turn)
    return [turn for turn in kept if not _is_implied(turn, kept)]


def _sample(mesh: Mesh) -> _Surface:
    size = diameter(mesh.vertices)
    face, weights = sample_surface(mesh, _SAMPLES, seed=0)
    many_faces, many_weights = sample_surface(mesh, _DENSE, seed=1)
    points = surface_points(mesh, face, weights)
    dense = surface_points(mesh, many_faces, many_weights)
    cross = face_normals(mesh.vertices, mesh.faces)
    unit = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-20)
    normals = 0.05 * size * unit
    sides = cKDTree(np.concatenate([dense, normals[many_faces]], axis=1))
    colors = surface_colors(mesh, many_faces, many_weights)
    near = sides.query(np.concatenate([points, normals[face]], axis=1), k=16)[1]
    return _Surface(
        points, normals[face], dense, cKDTree(dense), sides, colors, colors[near].mean(1), size
    )


def _candidate_axes(mesh: Mesh, surface: _Surface) -> list[np.ndarray]:
    """Return the principal axes of the surface, the axes of its smallest oriented box, and the
    directions of its third moment and of the middle of its convex hull, where they are not zero; of
    a solid whose moments of inertia are alike also those of its hull's faces.
    """
    hull = hull_vertices(mesh.vertices)
    deviations, principal = np.linalg.svd(
        surface.points - surface.points.mean(0), full_matrices=False
    )[1:]
    box = trimesh.bounds.oriented_bounds(hull)[0][:3, :3]
    middle = surface.dense.mean(0)
    centered = surface.dense - middle
    away = np.linalg.norm(centered, axis=1, keepdims=True)
    third = (away**2 * centered).mean(0) / (away**3).mean()
    solid = trimesh.convex.convex_hull(hull)
    with np.errstate(divide="ignore", invalid="ignore"):  # of a flat mesh without a volume
        to_hull = (solid.center_mass - middle) / away.mean()
    sizes = ((one, float(np.linalg.norm(one))) for one in (third, to_hull))
    moments = (one / size for one, size in sizes if _LEAST_MOMENT < size < 1)
    faces = _face_axes(solid) if deviations[2] > _ALIKE * deviations[0] else []
    return [*principal, *box, *moments, *faces]


def _face_axes(solid: trimesh.Trimesh) -> list[np.ndarray]:
    """Return the directions of a convex solid's large flat faces, one of opposite ones."""
    normals, areas, axes = solid.face_normals, np.array(solid.area_faces), []
    least = _LEAST_FACE * areas.sum()
    for triangle in np.argsort(-areas)[:_MOST_TRIANGLES]:
        along = normals @ normals[triangle]
        weights = np.where(np.abs(along) > _ONE_FACE, np.sign(along) * areas, 0)
        if np.abs(weights).sum() >= least:
            axis = weights @ normals
            axes.append(axis / np.linalg.norm(axis))
            areas[weights != 0] = 0  # of this face no other axis is made
    return axes


def _try(
    surface: _Surface, axis: np.ndarray, center: np.ndarray, fold: int
) -> RotationalSymmetry | None:
    """Refine and judge a turn; None where it is far from a symmetry."""
    angles = _ANY_ANGLES if fold == ANY else (2 * np.pi / fold,)
    start = rotation_about(axis, angles[0], center)
    if _distances(surface, start).mean() > _COARSE * surface.diameter:
        return None
    axis, point = _axis_of(_register(surface, start), axis)
    point = point + ((center - point) @ axis) * axis
    exact = [rotation_about(axis, angle, point) for angle in angles]
    before = _distances(surface, np.eye(4))
    after = [_distances(surface, turn) for turn in exact]
    distance = float(max(one.mean() for one in after) - before.mean())
    far = float(max(np.quantile(one, 0.98) for one in after) - np.quantile(before, 0.98))
    color = max(float(np.quantile(_color_change(surface, turn), 0.95)) for turn in exact)
    limit = surface.diameter
    shape = distance <= MEAN_EXCESS * limit and far <= FAR_EXCESS * limit
    texture = shape and color <= MOST_COLOR
    return RotationalSymmetry(axis, point, fold, distance, far, color, shape, texture)


def _distances(surface: _Surface, transform: np.ndarray) -> np.ndarray:
    """Return how far the samples, moved, are from the surface.  -> (P,) [m]."""
    return np.asarray(surface.nearest.query(move(surface.points, transform))[0])


def _color_change(surface: _Surface, transform: np.ndarray) -> np.ndarray:
    """Return by how much colors differ where the samples, moved, come to lie.  -> (P,) in [0, 1].

    Means of 16 neighbors on the same side of the surface: texture finer than the sampling is noise.
    """
    moved = move(surface.points, transform), surface.normals @ transform[:3, :3].T
    near = surface.nearest_side.query(np.concatenate(moved, axis=1), k=16)[1]
    return np.asarray(np.abs(surface.dense_colors[near].mean(1) - surface.colors).mean(1))


def _register(surface: _Surface, transform: np.ndarray) -> np.ndarray:
    """Refine a transform of the surface onto itself: closest points (Besl and McKay 1992), the
    farthest tenth left out.
    """
    for _ in range(15):
        moved = move(surface.points, transform)
        distance, near = surface.nearest.query(moved)
        kept = distance <= np.quantile(distance, 0.9)
        step, _, _ = trimesh.registration.procrustes(
            moved[kept], surface.dense[near[kept]], reflection=False, scale=False
        )
        transform = step @ transform
    return transform


def _axis_of(transform: np.ndarray, towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the axis of a turn, nearer to `towards` than away from it, and a point on it."""
    rotation = transform[:3, :3]
    vector = log_so3(torch.from_numpy(rotation)).numpy()
    axis = vector / max(np.linalg.norm(vector), 1e-12)
    point = np.linalg.pinv(np.eye(3) - rotation, rcond=1e-3) @ transform[:3, 3]
    return (axis if axis @ towards >= 0 else -axis), point


def _is_implied(turn: RotationalSymmetry, turns: Sequence[RotationalSymmetry]) -> bool:
    """Tell whether any turn about the same axis does, and as well, what a discrete one does."""
    return turn.fold != ANY and any(
        one.fold == ANY and are_parallel(one.axis, turn.axis) and (one.texture or not turn.texture)
        for one in turns
    )
