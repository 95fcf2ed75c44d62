"""Closed shapes with texture coordinates: boxes, lathed bodies, bent tubes.

Meters, z up, standing on z = 0.
"""

from typing import NamedTuple

import numpy as np

from posefilter.meshes.mesh import Mesh, creased_normals, grid_faces

Rect = tuple[float, float, float, float]  # u0, v0, u1, v1: part of the texture, origin bottom-left


class Soup(NamedTuple):
    """A triangle soup: corner positions and texture coordinates."""

    corners: np.ndarray  # (F, 3, 3) [m]
    uv: np.ndarray  # (F, 3, 2)


def join(*soups: Soup) -> Soup:
    """Concatenate triangle soups."""
    return Soup(np.concatenate([s.corners for s in soups]), np.concatenate([s.uv for s in soups]))


def weld(name: str, soup: Soup, texture: np.ndarray) -> Mesh:
    """Make a mesh: merge corners at one position, drop triangles without area."""
    rounded = np.round(soup.corners.reshape(-1, 3), 8)
    vertices, inverse = np.unique(rounded, axis=0, return_inverse=True)
    faces = inverse.reshape(-1, 3).astype(np.int64)
    solid = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    faces, uv = faces[solid], soup.uv[solid].astype(np.float32)
    return Mesh(name, vertices, faces, uv, texture, None, creased_normals(vertices, faces))


def transform(soup: Soup, linear: np.ndarray, shift: np.ndarray) -> Soup:
    """Map every corner by x -> linear @ x + shift; `linear` must not mirror.  (3, 3), (3,) [m]."""
    return Soup(soup.corners @ linear.T + shift, soup.uv)


def grid(points: np.ndarray, uv: np.ndarray) -> Soup:
    """Triangulate a grid of points.

    (R, C, 3), (R, C, 2); outside is where columns x rows points.
    """
    faces = grid_faces(*points.shape[:2])
    return Soup(points.reshape(-1, 3)[faces], uv.reshape(-1, 2)[faces])


def box(size: tuple[float, float, float], slots: dict[str, Rect], cuts: int = 4) -> Soup:
    """Return a box (x width, y depth, z height) whose faces show their slots upright, seen from
    outside.

    Front looks along -y, back +y, left -x, right +x; the top's and the bottom's pictures are
    upright for one who tips the box from the front. Each face is cut into cuts x cuts quads.
    """
    w, d, h = size[0] / 2, size[1] / 2, size[2]
    # face: bottom-left corner, bottom-right, top-left, as seen from outside
    frames = {
        "front": ((-w, -d, 0), (w, -d, 0), (-w, -d, h)),
        "back": ((w, d, 0), (-w, d, 0), (w, d, h)),
        "left": ((-w, d, 0), (-w, -d, 0), (-w, d, h)),
        "right": ((w, -d, 0), (w, d, 0), (w, -d, h)),
        "top": ((-w, -d, h), (w, -d, h), (-w, d, h)),
        "bottom": ((-w, d, 0), (w, d, 0), (-w, -d, 0)),
    }
    t = np.linspace(0, 1, cuts + 1)
    across, up = t[None, :, None], t[:, None, None]
    soups = []
    for face, (low_left, low_right, top_left) in frames.items():
        origin, right, top = (np.array(p, dtype=float) for p in (low_left, low_right, top_left))
        points = origin + across * (right - origin) + up * (top - origin)
        u0, v0, u1, v1 = slots[face]
        grid_u, grid_v = np.meshgrid(u0 + t * (u1 - u0), v0 + t * (v1 - v0))
        soups.append(grid(points, np.stack([grid_u, grid_v], -1)))
    return join(*soups)


def lathe(
    profile: list[tuple[float, ...]], rect: Rect, segments: int = 40, power: float = 2.0
) -> Soup:
    """Turn a profile round the z axis; the texture wraps once round, its height along the profile's
    length.

    Profile rows are (r, z) or (rx, ry, z) [m], outside on the right going up. Front is -y, at the
    texture's middle. `power` 2 is an ellipse, more is squarer (a superellipse).
    """
    rows = np.array([(p[0], p[0], p[1]) if len(p) == 2 else p for p in profile])
    ring = _ring(segments, power)
    heights = np.tile(rows[:, 2:], (1, segments + 1))
    points = np.concatenate([rows[:, None, :2] * ring, heights[..., None]], axis=-1)
    along = _arc(np.stack([rows[:, :2].mean(1), rows[:, 2]], 1))
    u0, v0, u1, v1 = rect
    u, v = np.meshgrid(np.linspace(u0, u1, segments + 1), v0 + along * (v1 - v0))
    return grid(points, np.stack([u, v], -1))


def disc(
    profile: list[tuple[float, ...]],
    center: tuple[float, float],
    radius: float,
    segments: int = 40,
    power: float = 2.0,
    up: bool = True,
) -> Soup:
    """Turn a profile round the z axis, its picture laid on flat: a lid (`up`) or a base.

    The widest ring maps to `radius` [texture units] round `center`.
    """
    soup = lathe(profile, (0, 0, 1, 1), segments, power)
    widest = max(max(p[:-1]) for p in profile)
    sign = np.array([1.0, 1.0 if up else -1.0])  # a base is seen from below
    return Soup(soup.corners, np.array(center) + soup.corners[..., :2] / widest * radius * sign)


def tube(
    path: np.ndarray,
    radii: np.ndarray,
    rect: Rect,
    segments: int = 12,
    sides: np.ndarray | None = None,
) -> Soup:
    """Sweep a circle along a plane path in x and z, closed at both ends.  (P, 3), (P,) [m].

    `sides` (P,) widens the circle along y by a factor.
    """
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.array([0.0, 1.0, 0.0])
    normal = np.cross(side, tangent)
    angle = np.arange(segments + 1) % segments * 2 * np.pi / segments
    stretch = np.ones(len(path)) if sides is None else sides
    ring = (
        np.cos(angle)[None, :, None] * normal[:, None]
        + np.sin(angle)[None, :, None] * stretch[:, None, None] * side[None, None]
    )
    points = path[:, None] + radii[:, None, None] * ring
    ends = np.repeat(path[[0, -1]][:, None], segments + 1, axis=1)
    points = np.concatenate([ends[:1], points, ends[1:]])
    u0, v0, u1, v1 = rect
    along = np.concatenate([[0.0], _arc(path), [1.0]])
    u, v = np.meshgrid(np.linspace(u0, u1, segments + 1), v0 + along * (v1 - v0))
    return grid(points, np.stack([u, v], -1))


def _ring(segments: int, power: float) -> np.ndarray:
    """Return a closed (super)ellipse of unit half axes, from the back (+y) through -x, front (-y),
    +x.  -> (S + 1, 2).
    """
    angle = np.pi / 2 + np.arange(segments + 1) % segments * 2 * np.pi / segments
    c, s = np.cos(angle), np.sin(angle)
    radius = (np.abs(c) ** power + np.abs(s) ** power) ** (-1 / power)
    return np.stack([c * radius, s * radius], -1)


def _arc(points: np.ndarray) -> np.ndarray:
    """Return the share of a polyline's length up to each point, from 0 to 1."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)]) / max(steps.sum(), 1e-12)
