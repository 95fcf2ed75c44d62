"""Triangle meshes and pure functions on them, in numpy."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError, cKDTree
from scipy.spatial.distance import cdist

from posefilter.errors import UserError
from posefilter.types import ObjectModel

_CREASE = np.cos(np.deg2rad(40.0))  # faces that meet at more than this share no normal
OPEN_EDGES = 0.01  # share of a surface's edges; one with more is not closed
_MOST_PAIRS = 4e8  # of faces that meet
_CHUNK = 1 << 24  # of such pairs at once
_POINT = 1e-6  # [m] a smaller object is in another unit
_HULL_VERTICES = 128
_HULL_DIRECTIONS = 5000  # some 2.9 degrees apart
_HULL_ERROR = 2.5e-4  # [m] stop refining the outline hull here
_MOST_HULL = 20_000  # vertices of a hull that are looked at: a smooth scan has more
_PAIRS = 1 << 24  # distances, or reaches, at once
_PART_POINTS = 300  # of a part's surface, beside the vertices of its hull
# how the names of distractors begin that are made for one set of rendered scenes: no file has them
LOOKALIKE = "lookalike_"


@dataclass(frozen=True, eq=False)
class Mesh:
    """A textured triangle mesh in its file's own frame [m].  Treat the arrays as read-only.

    Color at a surface point: texture (at `corner_uv`, bilinear) x `corner_colors`, each absent
    factor taken as one.
    """

    name: str
    vertices: np.ndarray  # (V, 3) float64 [m]
    faces: np.ndarray  # (F, 3) int64, counter-clockwise seen from outside
    # (F, 3, 2) float32, origin bottom-left as in OBJ; None when untextured
    corner_uv: np.ndarray | None
    texture: np.ndarray  # (h, w, 3) uint8 RGB, row 0 at the top (v = 1); 1 x 1 when plain
    corner_colors: np.ndarray | None  # (F, 3, 3) float32 in [0, 1]; None without vertex colors
    corner_normals: np.ndarray  # (F, 3, 3) float32, unit
    # (S, 4, 4) object_from_object, the identity first
    symmetries: np.ndarray = field(default_factory=lambda: np.eye(4)[None])
    # (F,) bool by part: the faces of each, disjoint; see meshes/parts.py
    parts: Mapping[str, np.ndarray] = field(default_factory=dict)
    # (V,) each vertex's number in its file, which may have others that no face uses; None: the same
    numbers: np.ndarray | None = None
    file_vertices: int | None = None  # how many its file has; None: as many

    @cached_property
    def bounds(self) -> np.ndarray:
        """Lowest and highest corner of the axis-aligned bounding box, (2, 3) [m]."""
        return np.stack([self.vertices.min(0), self.vertices.max(0)])

    @cached_property
    def reach(self) -> float:
        """How far points are from the bounding box's center at most: half of its diagonal [m]."""
        return float(np.linalg.norm(np.ptp(self.bounds, axis=0))) / 2

    @cached_property
    def hull_areas(self) -> tuple[float, float]:
        """Area of the convex hull's surface, and a bound of that of its projections [m^2].

        Along u, that is half the sum of a |n . u| over faces of area a and normal n; by Cauchy and
        Schwarz the sum is at most the root of (sum of a) times (sum of a (n . u)^2).
        """
        normals = face_normals(self.vertices, find_hull(self.vertices).simplices)
        areas = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
        largest = np.linalg.eigvalsh((normals / areas).T @ normals)[-1]
        return float(areas.sum() / 2), float(np.sqrt(areas.sum() * largest) / 4)


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return normals as long as twice the area of each triangle.  (V, 3) [m], (F, 3) -> (F, 3)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def face_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the area of each triangle.  (V, 3) [m], (F, 3) -> (F,) [m^2]."""
    return 0.5 * np.linalg.norm(face_normals(vertices, faces), axis=1)


def _weld(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the faces (F, 3) with one number for all vertices of one position."""
    _, numbers = np.unique(np.round(vertices, 7), axis=0, return_inverse=True)
    return numbers.reshape(-1)[faces]


def find_open_edges(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the share of edges that do not belong to two triangles.  (V, 3) [m], (F, 3).

    Triangles with two corners in one place, as at the poles of a ball, bound nothing.
    """
    corners = _weld(vertices, faces)
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    if len(corners) == 0:
        return 1.0
    edges = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return float((np.unique(edges, axis=0, return_counts=True)[1] != 2).mean())


def measure_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return what a closed surface contains; negative where its faces look inward.

    (V, 3) [m], (F, 3) -> [m^3].
    """
    center = (vertices.min(0) + vertices.max(0)) / 2
    a, b, c = (vertices[faces[:, i]] - center for i in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def looks_inward(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Return whether a surface is closed, with its faces looking inward.  (V, 3) [m], (F, 3).

    Of several bodies, the sum of their volumes decides.
    """
    inward = measure_volume(vertices, faces) < 0
    return inward and find_open_edges(vertices, faces) <= OPEN_EDGES


def creased_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Compute area-weighted normals that keep sharp edges.

    The normal of a corner averages the faces at its position that lie within 40 degrees of its own,
    so that seams in the texture do not show and boxes keep their edges.

    Args:
        vertices: (V, 3) [m].
        faces: (F, 3) indices.

    Returns:
        Unit normals of the corners (F, 3, 3) float32.

    Raises:
        ValueError: So many faces meet in one place that they are no surface.
    """
    weighted = face_normals(vertices, faces)
    length = np.linalg.norm(weighted, axis=1, keepdims=True)
    unit = weighted / np.maximum(length, 1e-20)
    corner_vertex = _weld(vertices, faces).reshape(-1)
    order = np.argsort(corner_vertex, kind="stable")
    starts = np.searchsorted(corner_vertex[order], np.arange(corner_vertex.max() + 2))
    total = np.zeros((len(corner_vertex), 3))
    counts = np.diff(starts)
    if (counts.astype(np.float64) ** 2).sum() > _MOST_PAIRS:
        raise ValueError(f"{counts.max():,} faces meet in one place")
    # all vertices with the same number of corners at once
    for size in np.unique(counts[counts > 0]):
        # (vertices, size) corners
        group = order[starts[:-1][counts == size][:, None] + np.arange(size)]
        for some in np.array_split(group, -(-group.size * size // _CHUNK)):
            face = some // 3
            for own in np.array_split(np.arange(size), -(-size * size // _CHUNK)):
                near = np.einsum("vic,vjc->vij", unit[face[:, own]], unit[face]) >= _CREASE
                total[some[:, own]] = np.einsum("vij,vjc->vic", near, weighted[face])
    norm = np.linalg.norm(total, axis=1, keepdims=True)
    fallback = np.where(length > 0, unit, [0.0, 0.0, 1.0]).repeat(3, axis=0)
    normals = np.where(norm > 0, total / np.maximum(norm, 1e-20), fallback)
    return normals.reshape(-1, 3, 3).astype(np.float32)


def sample_surface(mesh: Mesh, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Draw surface points uniformly by area.

    Faces are drawn by systematic sampling along their cumulative area, which spreads points better
    than independent draws.

    Args:
        mesh: The mesh.
        count: Number of points.
        seed: Of the random generator.

    Returns:
        Faces (count,) int64, and barycentric weights (count, 3).
    """
    rng = np.random.default_rng(seed)
    cumulated = np.cumsum(face_areas(mesh.vertices, mesh.faces))
    at = (np.arange(count) + rng.random()) / count * cumulated[-1]
    face = np.minimum(np.searchsorted(cumulated, at, side="right"), len(mesh.faces) - 1)
    root, v = np.sqrt(rng.random(count)), rng.random(count)
    return face, np.stack([1 - root, root * (1 - v), root * v], axis=1)


def surface_points(mesh: Mesh, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the points at barycentric weights on faces.  (P,), (P, 3) -> (P, 3) [m]."""
    return np.einsum("pi,pic->pc", weights, mesh.vertices[mesh.faces[face]])


def surface_colors(mesh: Mesh, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the colors at barycentric weights on faces.

    The texture is sampled bilinearly and repeats beyond its edges.

    Args:
        mesh: The mesh.
        face: (P,) indices.
        weights: (P, 3).

    Returns:
        (P, 3) float32 in [0, 1].
    """
    height, width = mesh.texture.shape[:2]
    if mesh.corner_uv is None:
        plain = (mesh.texture[0, 0] / np.float32(255)).astype(np.float32)
        color = np.tile(plain, (len(face), 1))
    else:
        uv = np.einsum("pi,pic->pc", weights, mesh.corner_uv[face])
        x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
        left, top = np.floor(x).astype(int), np.floor(y).astype(int)
        fx, fy = (x - left)[:, None], (y - top)[:, None]
        pixel = [
            [mesh.texture[(top + j) % height, (left + i) % width] for i in (0, 1)] for j in (0, 1)
        ]
        rows = [pixel[j][0] * (1 - fx) + pixel[j][1] * fx for j in (0, 1)]
        color = ((rows[0] * (1 - fy) + rows[1] * fy) / 255).astype(np.float32)
    if mesh.corner_colors is None:
        return color
    tint = np.einsum("pi,pic->pc", weights, mesh.corner_colors[face])
    return color * tint.astype(np.float32)


def find_hull(vertices: np.ndarray) -> ConvexHull:
    """Return the convex hull of vertices (V, 3).

    Raises UserError where there is none.
    """
    try:
        return ConvexHull(vertices)
    except QhullError:  # a flat mesh has no volume: joggle it
        pass
    try:
        return ConvexHull(vertices, qhull_options="QJ")
    except QhullError as error:
        size = float(np.ptp(vertices, axis=0).max())
        if len(vertices) < 4 and size > _POINT:
            text = f"mesh: has {len(vertices)} vertices; an object has 4 or more"
            raise UserError(text) from error
        raise UserError(
            f"mesh: has no convex hull; {size:.3g} m across, it is a point or too small: mind the "
            f"unit (mesh_scale)"
        ) from error


def hull_vertices(vertices: np.ndarray) -> np.ndarray:
    """Return the vertices of the convex hull; errors as of `find_hull`.  (V, 3) -> (H, 3)."""
    return vertices[find_hull(vertices).vertices]


def outline_hull(vertices: np.ndarray, max_vertices: int = _HULL_VERTICES) -> np.ndarray:
    """Select few hull vertices that have nearly the same outline.

    A silhouette is bounded by support functions h(d) = max x . d. Greedily, the direction is found
    in which h of the selected vertices is furthest below that of the full hull, and the vertex that
    is farthest there is added. The outline is never outside of the true one, and with 128 vertices
    within 1.2 mm of it for objects of 0.25 m.

    Args:
        vertices: (V, 3) [m].
        max_vertices: Largest number of vertices.

    Returns:
        (<= max_vertices, 3) [m].
    """
    full = hull_vertices(vertices)
    directions = sphere_directions(_HULL_DIRECTIONS)
    if len(full) > _MOST_HULL:
        full = full[_find_outermost(full, directions)]
    reach = full.astype(np.float32) @ directions.T.astype(np.float32)  # (H, D)
    target, best = reach.max(axis=0), reach.argmax(axis=0)
    extremes = [*full.argmax(axis=0).tolist(), *full.argmin(axis=0).tolist()]
    chosen = list(dict.fromkeys(extremes))
    have = reach[chosen].max(axis=0)
    while len(chosen) < max_vertices:
        worst = int(np.argmax(target - have))
        if target[worst] - have[worst] < _HULL_ERROR:
            break
        chosen.append(int(best[worst]))
        have = np.maximum(have, reach[chosen[-1]])
    return full[chosen]


def sphere_directions(count: int) -> np.ndarray:
    """Return evenly spread unit directions (Fibonacci lattice).  -> (count, 3)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * np.pi * (3 - np.sqrt(5))
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)


def _find_outermost(points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return which points are the outermost in any direction, along the axes too.

    (V, 3), (D, 3) -> (N,) indices.
    """
    both = np.concatenate([directions, np.eye(3), -np.eye(3)]).astype(np.float32)
    some = np.array_split(both, -(-len(both) * len(points) // _PAIRS))
    return np.unique(np.concatenate([(points.astype(np.float32) @ d.T).argmax(0) for d in some]))


def diameter(vertices: np.ndarray) -> float:
    """Return the largest distance between two vertices, exactly (over the hull's).

    (V, 3) [m] -> [m].
    """
    hull = hull_vertices(vertices)
    center = (hull.min(0) + hull.max(0)) / 2
    radius = np.linalg.norm(hull - center, axis=1)
    far = hull[radius.argmax()]
    for _ in range(3):  # from the outermost vertex to the farthest from it, and so on
        distance = np.linalg.norm(hull - far, axis=1)
        far = hull[distance.argmax()]
    least, most = (1 - 1e-9) * distance.max(), radius.max()
    hull, radius = (part[radius >= least - most] for part in (hull, radius))
    if len(hull) ** 2 <= _PAIRS:
        return float(cdist(hull, hull).max())
    # what is farther than that from a vertex lies in a cap round the opposite of it: of a ball's
    # vertices few
    cosine = (least**2 - radius**2 - most**2) / (2 * radius * most)
    cap = (1 + 1e-6) * most * np.sqrt((2 - 2 * cosine).clip(0)) + 1e-9 * most
    opposite = center - (hull - center) * (most / radius)[:, None]
    tree = cKDTree(hull)
    best = 0.0
    for some in np.array_split(np.arange(len(hull)), -(-(len(hull) ** 2) // _PAIRS)):
        near = tree.query_ball_point(opposite[some], cap[some])
        start = np.repeat(some, [len(one) for one in near])
        end = np.concatenate([np.asarray(one, int) for one in near])
        best = max(best, np.linalg.norm(hull[start] - hull[end], axis=1).max(initial=0.0))
    return float(best)


def object_model(
    mesh: Mesh, points: np.ndarray | None = None, count: int = 2000, seed: int = 0
) -> ObjectModel:
    """Return the object as methods and metrics use it.

    Args:
        mesh: The mesh.
        points: (P, 3) [m] in the mesh's frame, on which ADD is defined; None: drawn uniformly from
            the surface.
        count: How many points are drawn.
        seed: Of the random generator; the same seed gives the same points.
    """
    if points is None:
        points = surface_points(mesh, *sample_surface(mesh, count, seed))
    low, high = mesh.bounds
    return ObjectModel(
        name=mesh.name,
        points=torch.from_numpy(np.ascontiguousarray(points, dtype=np.float32)),
        center=torch.from_numpy(((low + high) / 2).astype(np.float32)),
        radius=float(np.linalg.norm(high - low) / 2),
        diameter=diameter(mesh.vertices),
        symmetries=torch.from_numpy(mesh.symmetries.astype(np.float32)),
        hull=torch.from_numpy(outline_hull(mesh.vertices).astype(np.float32)),
        parts={part: _part_points(mesh, faces, seed) for part, faces in mesh.parts.items()} or None,
    )


def _part_points(mesh: Mesh, faces: np.ndarray, seed: int) -> torch.Tensor:
    """Return the vertices of a part's hull, and points of its surface.  (F,) bool -> (P, 3) [m]."""
    own = replace(mesh, faces=mesh.faces[faces], parts={})
    hull = outline_hull(mesh.vertices[np.unique(own.faces)])
    surface = surface_points(own, *sample_surface(own, _PART_POINTS, seed))
    return torch.from_numpy(np.concatenate([hull, surface]).astype(np.float32))


def grid_faces(rows: int, columns: int) -> np.ndarray:
    """Return the triangles of a grid of vertices.

    Args:
        rows: Rows of vertices, which are numbered row by row.
        columns: Columns of vertices.

    Returns:
        (2 * (rows - 1) * (columns - 1), 3) indices.
    """
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    c, d = index[1:, 1:].ravel(), index[1:, :-1].ravel()
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
