"""Render colored depth images of meshes with Embree, one ray a pixel.

Each mesh is built into one Embree scene in its own frame; rays are moved into that frame, which
costs nothing to pose and lets one mesh stand in a picture many times, stretched or not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import cv2
import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh

from posefilter.meshes.mesh import Mesh, hull_vertices
from posefilter.rendering.sampling import MipmapCache, sample_texture
from posefilter.rendering.surfaces import (
    NEAR,
    Instance,
    Lights,
    Plane,
    Rendered,
    Renderer,
    Surfaces,
    covered_pixels,
    pixel_rays,
    shade,
    unit,
)

__all__ = [
    "EmbreeRenderer",
    "Instance",
    "Lights",
    "Plane",
    "Rendered",
    "Renderer",
    "Surfaces",
    "render_depth",
]


@dataclass(eq=False)
class _Prepared:
    """A mesh as the ray caster wants it."""

    mesh: Mesh
    scene: Any
    normals: np.ndarray  # (F, 3, 3) float32
    uv: np.ndarray | None  # (F, 3, 2) float32
    colors: np.ndarray | None  # (F, 3, 3) float32 in [0, 1]
    hull: np.ndarray  # (V, 3) vertices of the convex hull
    uv_per_meter: float  # how much of the texture's side one meter of surface takes


@dataclass(eq=False)
class EmbreeRenderer:
    """Cast one ray a pixel with Embree.

    Keeps the `keep` newest meshes built; not to be shared between processes.
    """

    keep: int = 96
    _meshes: dict[int, _Prepared] = field(default_factory=dict)
    _pyramids: MipmapCache = field(default_factory=MipmapCache)

    def render(
        self,
        instances: Sequence[Instance],
        K: np.ndarray,
        height: int,
        width: int,
        lights: Lights,
        planes: Sequence[Plane] = (),
    ) -> Rendered:
        """Return the picture of the instances before the planes."""
        seen = self.surfaces(instances, K, height, width, planes)
        rays = pixel_rays(K, height, width)
        shadow = self.shadow(seen, rays, instances, lights) if lights.shadows else None
        return Rendered(shade(seen, rays, lights, shadow), seen.depth, seen.index, seen.unoccluded)

    def surfaces(
        self,
        instances: Sequence[Instance],
        K: np.ndarray,
        height: int,
        width: int,
        planes: Sequence[Plane] = (),
    ) -> Surfaces:
        """Return what each pixel sees of the instances and planes."""
        rays = pixel_rays(K, height, width)
        far = np.full((height, width), np.inf, np.float32)
        albedo, normal = np.zeros((2, height, width, 3), np.float32)
        index = np.full((height, width), -1, np.int32)
        alone = np.zeros(len(instances), np.int64)
        hits = [self._cast(one, rays, K) for one in instances]
        for i, hit in enumerate(hits):
            alone[i] = len(hit.pixel)
            near = hit.t < far.reshape(-1)[hit.pixel]
            far.reshape(-1)[hit.pixel[near]] = hit.t[near]
            index.reshape(-1)[hit.pixel[near]] = i
        for plane in planes:
            self._write_plane(plane, rays, K, far, albedo, normal, index)
        for i, (one, hit) in enumerate(zip(instances, hits, strict=True)):
            mine = (index.reshape(-1)[hit.pixel] == i) & (hit.t == far.reshape(-1)[hit.pixel])
            self._write_instance(one, hit.keep(mine), K, rays, albedo, normal)
        return Surfaces(
            albedo, normal, np.where(np.isfinite(far), far, np.float32(0)), index, alone
        )

    def depth(
        self, instances: Sequence[Instance], K: np.ndarray, height: int, width: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return z-depth (H, W) [m], 0 = nothing, and which instance is seen (H, W), -1 = none."""
        rays = pixel_rays(K, height, width)
        far, index = (
            np.full(height * width, np.inf, np.float32),
            np.full(height * width, -1, np.int32),
        )
        for i, one in enumerate(instances):
            hit = self._cast(one, rays, K)
            near = hit.t < far[hit.pixel]
            far[hit.pixel[near]], index[hit.pixel[near]] = hit.t[near], i
        far[index < 0] = 0
        return far.reshape(height, width), index.reshape(height, width)

    def shadow(
        self,
        seen: Surfaces,
        rays: np.ndarray,
        instances: Sequence[Instance],
        lights: Lights,
        stride: int = 3,
    ) -> np.ndarray:
        """Return how much of the first light reaches each pixel, in [0, 1].  -> (H, W) float32.

        Rays are cast from every third pixel only and the answer is smoothed: soft edges are what an
        extended light gives.
        """
        coarse = (slice(None, None, stride), slice(None, None, stride))
        points = rays[coarse] * seen.depth[coarse][..., None] + 0.002 * seen.normal[coarse]
        shape = points.shape[:2]
        points = points.reshape(-1, 3)
        L = unit(np.asarray(lights.directions[0], np.float32))
        lit = np.ones(len(points), np.float32)
        for one in instances:
            ready = self._prepare(one.mesh)
            center, radius = _sphere(one, ready)
            offset = center - points
            along = offset @ L
            near = (
                (along > -radius)
                & ((offset * offset).sum(1) - along * along < radius * radius)
                & (lit > 0)
            )
            where = np.flatnonzero(near)
            if len(where) == 0:
                continue
            inverse = np.linalg.inv(one.camera_from_object)
            origin = (points[where] @ inverse[:3, :3].T + inverse[:3, 3]).astype(np.float32)
            direction = np.broadcast_to(
                (inverse[:3, :3] @ L).astype(np.float32), origin.shape
            ).copy()
            lit[where[ready.scene.run(origin, direction, query="OCCLUDED") >= 0]] = 0
        soft = cv2.GaussianBlur(lit.reshape(shape), (0, 0), lights.shadow_blur)
        # cell (i, j) was sampled at pixel stride * i: shift the enlarged map accordingly
        height, width = seen.depth.shape
        scale = np.array([[1 / stride, 0, 0], [0, 1 / stride, 0]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(
            soft, scale, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
        )

    def _prepare(self, mesh: Mesh) -> _Prepared:
        """Build a mesh's Embree scene once."""
        key = id(mesh)
        if key not in self._meshes:
            corners = np.ascontiguousarray(mesh.vertices[mesh.faces], dtype=np.float32)
            scene = rtcore_scene.EmbreeScene()
            TriangleMesh(scene, corners)
            uv = None if mesh.corner_uv is None else mesh.corner_uv.astype(np.float32)
            colors = None if mesh.corner_colors is None else mesh.corner_colors.astype(np.float32)
            hull = hull_vertices(mesh.vertices[np.unique(mesh.faces)])
            density = (
                0.0
                if uv is None
                else float(np.sqrt(_area(uv).sum() / max(_area(corners).sum(), 1e-12)))
            )
            while len(self._meshes) >= self.keep:
                del self._meshes[next(iter(self._meshes))]
            self._meshes[key] = _Prepared(
                mesh, scene, mesh.corner_normals.astype(np.float32), uv, colors, hull, density
            )
        return self._meshes[key]

    def _cast(self, one: Instance, rays: np.ndarray, K: np.ndarray) -> "_Hits":
        """Cast the rays of the pixels that the instance's convex hull covers."""
        ready = self._prepare(one.mesh)
        pixel = covered_pixels(
            ready.hull @ one.camera_from_object[:3, :3].T + one.camera_from_object[:3, 3],
            K,
            rays.shape[:2],
        )
        if len(pixel) == 0:
            none = np.zeros(0, np.float32)
            return _Hits(pixel, none, none, none, np.zeros(0, np.int32))
        inverse = np.linalg.inv(one.camera_from_object)
        direction = rays.reshape(-1, 3)[pixel] @ inverse[:3, :3].T.astype(np.float32)
        origin = np.broadcast_to(inverse[:3, 3].astype(np.float32), direction.shape).copy()
        out = ready.scene.run(origin, direction, query="INTERSECT", output=True)
        hit = (out["primID"] >= 0) & (out["tfar"] > NEAR)
        return _Hits(pixel[hit], out["tfar"][hit], out["u"][hit], out["v"][hit], out["primID"][hit])

    def _write_instance(
        self,
        one: Instance,
        hit: "_Hits",
        K: np.ndarray,
        rays: np.ndarray,
        albedo: np.ndarray,
        normal: np.ndarray,
    ) -> None:
        """Write an instance's color and normals into the buffers."""
        if len(hit.pixel) == 0:
            return
        ready = self._prepare(one.mesh)
        corner = np.stack([1 - hit.u - hit.v, hit.u, hit.v], axis=1)
        linear = one.camera_from_object[:3, :3]
        n = _blend(ready.normals, hit.face, corner) @ np.linalg.inv(linear).astype(np.float32)
        n /= np.linalg.norm(n, axis=1, keepdims=True) + 1e-12
        away = (n * rays.reshape(-1, 3)[hit.pixel]).sum(1) > 0
        n[away] *= -1
        normal.reshape(-1, 3)[hit.pixel] = n
        texture = one.mesh.texture if one.texture is None else one.texture
        if ready.uv is None:
            color = np.broadcast_to(texture[0, 0] / np.float32(255), n.shape)
        else:
            stretch = max(float(abs(np.linalg.det(linear))) ** (1 / 3), 1e-6)
            texels_per_meter = ready.uv_per_meter * max(texture.shape[:2]) / stretch
            level = self._pyramids.level(
                texture, texels_per_meter * float(np.median(hit.t)) / K[0, 0]
            )
            uv = _blend(ready.uv, hit.face, corner)
            color = sample_texture(level, uv[:, 0], uv[:, 1])
        if ready.colors is not None:
            color = color * _blend(ready.colors, hit.face, corner)
        albedo.reshape(-1, 3)[hit.pixel] = color

    def _write_plane(
        self,
        plane: Plane,
        rays: np.ndarray,
        K: np.ndarray,
        far: np.ndarray,
        albedo: np.ndarray,
        normal: np.ndarray,
        index: np.ndarray,
    ) -> None:
        """Write a plane into the buffers where it is the nearest so far."""
        R, origin = (
            plane.camera_from_plane[:3, :3].astype(np.float32),
            plane.camera_from_plane[:3, 3].astype(np.float32),
        )
        facing = rays @ R[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            z = np.float32(origin @ R[:, 2]) / facing
        pixel = np.flatnonzero((z > NEAR) & (z < far) & (z < 50))
        if len(pixel) == 0:
            return
        t = z.reshape(-1)[pixel]
        a, b = ((rays.reshape(-1, 3)[pixel] * t[:, None] - origin) @ R[:, :2]).T
        inside = (np.abs(a) < plane.half_extent[0]) & (np.abs(b) < plane.half_extent[1])
        pixel, t, a, b = pixel[inside], t[inside], a[inside], b[inside]
        if len(pixel) == 0:
            return
        density = plane.texture.shape[0] / plane.tile * float(np.median(t)) / K[0, 0]
        far.reshape(-1)[pixel] = t
        index.reshape(-1)[pixel] = -1
        n = R[:, 2]
        normal.reshape(-1, 3)[pixel] = np.where((facing.reshape(-1)[pixel] > 0)[:, None], -n, n)
        albedo.reshape(-1, 3)[pixel] = sample_texture(
            self._pyramids.level(plane.texture, density), a / plane.tile, b / plane.tile
        )


class _Hits(NamedTuple):
    """Where rays met one mesh."""

    pixel: np.ndarray  # (P,) flat index
    t: np.ndarray  # (P,) z-depth [m]
    u: np.ndarray  # (P,) barycentric weight of the second corner
    v: np.ndarray  # (P,) and of the third
    face: np.ndarray  # (P,)

    def keep(self, mask: np.ndarray) -> "_Hits":
        """Return the hits that a mask chooses."""
        return _Hits(*(x[mask] for x in self))


def render_depth(
    meshes: Sequence[Mesh],
    camera_from_object: Sequence[np.ndarray],
    K: np.ndarray,
    height: int,
    width: int,
    renderer: EmbreeRenderer | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return z-depth (H, W) float32 [m], 0 = nothing, and the index of the mesh seen (H, W) int32,
    -1 = none.

    camera_from_object: a (4, 4) [m] for each mesh. Pass a renderer to keep its meshes built between
    calls.
    """
    instances = [
        Instance(mesh, np.asarray(pose, np.float64))
        for mesh, pose in zip(meshes, camera_from_object, strict=True)
    ]
    return (renderer or EmbreeRenderer()).depth(instances, np.asarray(K, np.float64), height, width)


def _sphere(one: Instance, ready: _Prepared) -> tuple[np.ndarray, float]:
    """Return center (3,) and radius of a sphere round an instance, in the camera [m]."""
    points = ready.hull @ one.camera_from_object[:3, :3].T + one.camera_from_object[:3, 3]
    center = (points.min(0) + points.max(0)) / 2
    return center.astype(np.float32), float(np.linalg.norm(points - center, axis=1).max())


def _blend(corners: np.ndarray, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Interpolate over triangles.  (F, 3, C), (P,), (P, 3) -> (P, C)."""
    return np.einsum("pkc,pk->pc", corners[face], weights)


def _area(corners: np.ndarray) -> np.ndarray:
    """Return the area of triangles.  (F, 3, 2 or 3) -> (F,)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    square = (a * a).sum(-1) * (b * b).sum(-1) - (a * b).sum(-1) ** 2
    return np.sqrt(np.maximum(square, 0)) / 2
