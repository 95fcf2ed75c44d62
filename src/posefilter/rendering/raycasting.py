"""Cast rays at meshes with Embree.

Each mesh is built into one Embree scene in its own frame, and rays are transformed into that frame.
A pose then costs nothing, and one mesh can stand in an image many times, scaled or not.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np

from posefilter.errors import UserError
from posefilter.geometry.rigid import move
from posefilter.meshes.mesh import Mesh, hull_vertices
from posefilter.rendering.surfaces import NEAR, Instance, Lights, Surfaces, covered_pixels, unit


@dataclass(eq=False)
class CastMesh:
    """A mesh with its Embree scene."""

    scene: Any
    normals: np.ndarray  # (F, 3, 3) float32
    uv: np.ndarray | None  # (F, 3, 2) float32
    colors: np.ndarray | None  # (F, 3, 3) float32 in [0, 1]
    hull: np.ndarray  # (V, 3) vertices of the convex hull
    uv_per_meter: float  # texture coordinates for each meter of surface


class Hits(NamedTuple):
    """Where rays hit one mesh."""

    pixel: np.ndarray  # (P,) flat index
    t: np.ndarray  # (P,) z-depth [m]
    u: np.ndarray  # (P,) barycentric weight of the second corner
    v: np.ndarray  # (P,) and of the third
    face: np.ndarray  # (P,)

    def keep(self, mask: np.ndarray) -> "Hits":
        """Return the hits that a mask (P,) selects."""
        return Hits(*(x[mask] for x in self))


def _build_scene(corners: np.ndarray) -> Any:
    """Return an Embree scene of triangles (F, 3, 3) float32."""
    try:  # here: what renders nothing, such as prediction, runs without it
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh
    except ImportError as error:
        raise UserError(
            "rendering: the package embreex is missing; on Linux there is one for x86-64 alone "
            "(predict, track and convert_bag need none, but for meshes=)"
        ) from error
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, corners)
    return scene


def _prepare(mesh: Mesh) -> CastMesh:
    """Return a mesh with its Embree scene.

    Raises:
        UserError: Embree is missing.
    """
    corners = np.ascontiguousarray(mesh.vertices[mesh.faces], dtype=np.float32)
    scene = _build_scene(corners)
    uv = None if mesh.corner_uv is None else mesh.corner_uv.astype(np.float32)
    colors = None if mesh.corner_colors is None else mesh.corner_colors.astype(np.float32)
    hull = hull_vertices(mesh.vertices[np.unique(mesh.faces)])
    density = 0.0
    if uv is not None:
        density = float(np.sqrt(_area(uv).sum() / max(_area(corners).sum(), 1e-12)))
    return CastMesh(scene, mesh.corner_normals.astype(np.float32), uv, colors, hull, density)


class RayCaster:
    """Meshes built for Embree; must not be shared between processes.

    Args:
        keep: The number of meshes that stay built, those that were cast at last.
    """

    def __init__(self, keep: int = 96) -> None:
        self.prepare = lru_cache(maxsize=keep)(_prepare)

    def cast(self, one: Instance, rays: np.ndarray, K: np.ndarray) -> Hits:
        """Cast the rays of the pixels that an instance's convex hull covers.

        Args:
            one: The instance.
            rays: (H, W, 3) of all pixels; see `pixel_rays`.
            K: (3, 3) camera matrix [px].
        """
        mesh = self.prepare(one.mesh)
        pixel = covered_pixels(move(mesh.hull, one.camera_from_object), K, rays.shape[:2])
        if len(pixel) == 0:
            empty = np.zeros(0, np.float32)
            return Hits(pixel, empty, empty, empty, np.zeros(0, np.int32))
        inverse = np.linalg.inv(one.camera_from_object)
        direction = rays.reshape(-1, 3)[pixel] @ inverse[:3, :3].T.astype(np.float32)
        origin = np.broadcast_to(inverse[:3, 3].astype(np.float32), direction.shape).copy()
        out = mesh.scene.run(origin, direction, query="INTERSECT", output=True)
        hit = (out["primID"] >= 0) & (out["tfar"] > NEAR)
        return Hits(pixel[hit], out["tfar"][hit], out["u"][hit], out["v"][hit], out["primID"][hit])

    def shadow(
        self, surfaces: Surfaces, rays: np.ndarray, instances: Sequence[Instance], lights: Lights
    ) -> np.ndarray:
        """Compute how much of the first light reaches each pixel.

        Rays are cast from every third pixel and the result is smoothed: an extended light has
        soft shadows.

        Args:
            surfaces: What each pixel sees.
            rays: (H, W, 3) of all pixels.
            instances: What casts shadows.
            lights: The first of them casts shadows.

        Returns:
            (H, W) float32 in [0, 1].
        """
        stride = 3
        coarse = (slice(None, None, stride), slice(None, None, stride))
        points = rays[coarse] * surfaces.depth[coarse][..., None] + 0.002 * surfaces.normal[coarse]
        shape = points.shape[:2]
        points = points.reshape(-1, 3)
        L = unit(np.asarray(lights.directions[0], np.float32))
        lit = np.ones(len(points), np.float32)
        for one in instances:
            mesh = self.prepare(one.mesh)
            center, radius = _bounding_sphere(one, mesh)
            offset = center - points
            along = offset @ L
            near = (offset * offset).sum(1) - along * along < radius * radius
            where = np.flatnonzero((along > -radius) & near & (lit > 0))
            if len(where) == 0:
                continue
            inverse = np.linalg.inv(one.camera_from_object)
            origin = move(points[where], inverse).astype(np.float32)
            towards = (inverse[:3, :3] @ L).astype(np.float32)
            direction = np.broadcast_to(towards, origin.shape).copy()
            lit[where[mesh.scene.run(origin, direction, query="OCCLUDED") >= 0]] = 0
        soft = cv2.GaussianBlur(lit.reshape(shape), (0, 0), lights.shadow_blur)
        # cell (i, j) was sampled at pixel stride * i: shift the enlarged map accordingly
        height, width = surfaces.depth.shape
        scale = np.array([[1 / stride, 0, 0], [0, 1 / stride, 0]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(
            soft, scale, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
        )


def _bounding_sphere(one: Instance, mesh: CastMesh) -> tuple[np.ndarray, float]:
    """Return center (3,) and radius of an instance's bounding sphere, in the camera [m]."""
    points = move(mesh.hull, one.camera_from_object)
    center = (points.min(0) + points.max(0)) / 2
    return center.astype(np.float32), float(np.linalg.norm(points - center, axis=1).max())


def _area(corners: np.ndarray) -> np.ndarray:
    """Return the area of triangles.  (F, 3, 2 or 3) -> (F,)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    square = (a * a).sum(-1) * (b * b).sum(-1) - (a * b).sum(-1) ** 2
    return np.sqrt(np.maximum(square, 0)) / 2
