"""Render coloured depth images of meshes: a renderer fills buffers of what each pixel sees, one function lights them.

Camera axes as everywhere (OpenCV, pixel centres at integers). Rays are left as [x, y, 1], so that the distance along a ray *is*
the z-depth. Each mesh is built into one Embree scene in its own frame; rays are moved into that frame, which costs nothing to
pose and lets one mesh stand in a picture many times, stretched or not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh

from posefilter.data.mesh import Mesh, hull_vertices

NEAR = 0.02  # [m]; a mesh with a vertex nearer than this is searched for in the whole frame
_ROW = 4096  # cv2.remap takes no side above 32767, so samples are folded into rows of this length


@dataclass(frozen=True, eq=False)
class Instance:
    """One mesh in the picture."""

    mesh: Mesh
    camera_from_object: np.ndarray  # (4, 4) [m]; its linear part may stretch
    texture: np.ndarray | None = None  # (h, w, 3) uint8, instead of the mesh's own


@dataclass(frozen=True, eq=False)
class Plane:
    """A textured rectangle in its own z = 0."""

    camera_from_plane: np.ndarray  # (4, 4) [m], rigid
    half_extent: tuple[float, float]  # [m] along its x and y
    texture: np.ndarray  # (h, w, 3) uint8, repeated
    tile: float  # the side of one copy of the texture [m]


@dataclass(frozen=True)
class Lights:
    """Ambient light, and lights infinitely far away."""

    ambient: float = 0.6
    directions: tuple[tuple[float, float, float], ...] = ((0.3, -0.7, -0.6),)  # towards the light, camera axes
    strengths: tuple[float, ...] = (0.5,)
    specular: float = 0.0
    shininess: float = 20.0
    shadows: bool = False  # of the instances, cast by the first light
    shadow_blur: float = 1.0  # [px / 3]
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # colour where nothing is


class Surfaces(NamedTuple):
    """What each pixel sees, before light."""

    albedo: np.ndarray  # (H, W, 3) float32 in [0, 1]
    normal: np.ndarray  # (H, W, 3) float32 unit, camera axes, towards the camera
    depth: np.ndarray  # (H, W) float32 [m], 0 = nothing
    index: np.ndarray  # (H, W) int32 into the instances, -1 = none of them
    alone: np.ndarray  # (I,) pixels in the frame that each instance would have were it alone


class Rendered(NamedTuple):
    """A lit picture."""

    rgb: np.ndarray  # (H, W, 3) float32, 1 = white, may exceed it
    depth: np.ndarray  # (H, W) float32 [m], 0 = nothing
    index: np.ndarray  # (H, W) int32 into the instances, -1 = none of them
    alone: np.ndarray  # (I,) pixels in the frame that each instance would have were it alone


class Renderer(Protocol):
    """Anything that turns instances into pictures."""

    def render(
        self, instances: Sequence[Instance], K: np.ndarray, height: int, width: int, lights: Lights, planes: Sequence[Plane] = ()
    ) -> Rendered:
        """Return the picture of the instances before the planes."""
        ...


def pixel_rays(K: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return the ray [x, y, 1] of every pixel centre.  -> (H, W, 3) float32."""
    rays = np.ones((height, width, 3), np.float32)
    rays[..., 0] = (np.arange(width) - K[0, 2]) / K[0, 0]
    rays[..., 1] = ((np.arange(height) - K[1, 2]) / K[1, 1])[:, None]
    return rays


def sample_texture(texture: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Look up colours bilinearly, (0, 0) the texture's bottom left, repeated.  (h, w, 3) uint8, (P,) x 2 -> (P, 3) float32 in [0, 1]."""
    h, w = texture.shape[:2]
    n = len(u)
    fold = np.zeros((2, -(-n // _ROW) * _ROW), np.float32)
    fold[0, :n] = (u - np.floor(u)) * w - 0.5
    fold[1, :n] = (1 - (v - np.floor(v))) * h - 0.5
    x, y = fold.reshape(2, -1, _ROW)
    out = cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return out.reshape(-1, 3)[:n] * np.float32(1 / 255)


@dataclass(eq=False)
class _Prepared:
    """A mesh as the ray caster wants it."""

    mesh: Mesh
    scene: Any
    normals: np.ndarray  # (F, 3, 3) float32
    uv: np.ndarray | None  # (F, 3, 2) float32
    colors: np.ndarray | None  # (F, 3, 3) float32 in [0, 1]
    hull: np.ndarray  # (V, 3) vertices of the convex hull
    uv_per_metre: float  # how much of the texture's side one metre of surface takes


@dataclass(eq=False)
class EmbreeRenderer:
    """Cast one ray a pixel with Embree.  Keeps the `keep` newest meshes built; not to be shared between processes."""

    keep: int = 96
    _meshes: dict[int, _Prepared] = field(default_factory=dict)
    _pyramids: dict[int, list[np.ndarray]] = field(default_factory=dict)

    def render(
        self, instances: Sequence[Instance], K: np.ndarray, height: int, width: int, lights: Lights, planes: Sequence[Plane] = ()
    ) -> Rendered:
        """Return the picture of the instances before the planes."""
        seen = self.surfaces(instances, K, height, width, planes)
        rays = pixel_rays(K, height, width)
        shadow = self.shadow(seen, rays, instances, lights) if lights.shadows else None
        return Rendered(light(seen, rays, lights, shadow), seen.depth, seen.index, seen.alone)

    def surfaces(self, instances: Sequence[Instance], K: np.ndarray, height: int, width: int, planes: Sequence[Plane] = ()) -> Surfaces:
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
            self._paint_plane(plane, rays, K, far, albedo, normal, index)
        for i, (one, hit) in enumerate(zip(instances, hits, strict=True)):
            mine = (index.reshape(-1)[hit.pixel] == i) & (hit.t == far.reshape(-1)[hit.pixel])
            self._paint(one, hit.keep(mine), K, rays, albedo, normal)
        return Surfaces(albedo, normal, np.where(np.isfinite(far), far, np.float32(0)), index, alone)

    def depth(self, instances: Sequence[Instance], K: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
        """Return z-depth (H, W) [m], 0 = nothing, and which instance is seen (H, W), -1 = none."""
        rays = pixel_rays(K, height, width)
        far, index = np.full(height * width, np.inf, np.float32), np.full(height * width, -1, np.int32)
        for i, one in enumerate(instances):
            hit = self._cast(one, rays, K)
            near = hit.t < far[hit.pixel]
            far[hit.pixel[near]], index[hit.pixel[near]] = hit.t[near], i
        far[index < 0] = 0
        return far.reshape(height, width), index.reshape(height, width)

    def shadow(self, seen: Surfaces, rays: np.ndarray, instances: Sequence[Instance], lights: Lights, stride: int = 3) -> np.ndarray:
        """Return how much of the first light reaches each pixel, in [0, 1].  -> (H, W) float32.

        Rays are cast from every third pixel only and the answer is smoothed: soft edges are what an extended light gives.
        """
        coarse = (slice(None, None, stride), slice(None, None, stride))
        points = rays[coarse] * seen.depth[coarse][..., None] + 0.002 * seen.normal[coarse]
        shape = points.shape[:2]
        points = points.reshape(-1, 3)
        L = _unit(np.asarray(lights.directions[0], np.float32))
        lit = np.ones(len(points), np.float32)
        for one in instances:
            ready = self._prepare(one.mesh)
            center, radius = _sphere(one, ready)
            offset = center - points
            along = offset @ L
            near = (along > -radius) & ((offset * offset).sum(1) - along * along < radius * radius) & (lit > 0)
            where = np.flatnonzero(near)
            if len(where) == 0:
                continue
            inverse = np.linalg.inv(one.camera_from_object)
            origin = (points[where] @ inverse[:3, :3].T + inverse[:3, 3]).astype(np.float32)
            direction = np.broadcast_to((inverse[:3, :3] @ L).astype(np.float32), origin.shape).copy()
            lit[where[ready.scene.run(origin, direction, query="OCCLUDED") >= 0]] = 0
        soft = cv2.GaussianBlur(lit.reshape(shape), (0, 0), lights.shadow_blur)
        # cell (i, j) was sampled at pixel stride * i: shift the enlarged map accordingly
        height, width = seen.depth.shape
        scale = np.array([[1 / stride, 0, 0], [0, 1 / stride, 0]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(soft, scale, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)

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
            density = 0.0 if uv is None else float(np.sqrt(_area(uv).sum() / max(_area(corners).sum(), 1e-12)))
            while len(self._meshes) >= self.keep:
                del self._meshes[next(iter(self._meshes))]
            self._meshes[key] = _Prepared(mesh, scene, mesh.corner_normals.astype(np.float32), uv, colors, hull, density)
        return self._meshes[key]

    def _texture(self, texture: np.ndarray, texels_per_pixel: float) -> np.ndarray:
        """Return the texture halved until one texel is about one pixel, so that it does not alias."""
        key = id(texture)
        if key not in self._pyramids:
            if len(self._pyramids) > 256:
                self._pyramids.clear()
            self._pyramids[key] = [texture]  # holds the array, so that its id stays its own
        levels = self._pyramids[key]
        wanted = int(np.clip(np.floor(np.log2(max(texels_per_pixel, 1e-6)) + 0.25), 0, 6))
        while len(levels) <= wanted and min(levels[-1].shape[:2]) >= 8:
            levels.append(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
        return levels[min(wanted, len(levels) - 1)]

    def _cast(self, one: Instance, rays: np.ndarray, K: np.ndarray) -> "_Hits":
        """Cast the rays of the pixels that the instance's convex hull covers."""
        ready = self._prepare(one.mesh)
        pixel = _covered_pixels(ready.hull @ one.camera_from_object[:3, :3].T + one.camera_from_object[:3, 3], K, rays.shape[:2])
        if len(pixel) == 0:
            return _Hits(pixel, *np.zeros((3, 0), np.float32), np.zeros(0, np.int32))
        inverse = np.linalg.inv(one.camera_from_object)
        direction = rays.reshape(-1, 3)[pixel] @ inverse[:3, :3].T.astype(np.float32)
        origin = np.broadcast_to(inverse[:3, 3].astype(np.float32), direction.shape).copy()
        out = ready.scene.run(origin, direction, query="INTERSECT", output=True)
        hit = (out["primID"] >= 0) & (out["tfar"] > NEAR)
        return _Hits(pixel[hit], out["tfar"][hit], out["u"][hit], out["v"][hit], out["primID"][hit])

    def _paint(self, one: Instance, hit: "_Hits", K: np.ndarray, rays: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> None:
        """Write an instance's colour and normals into the buffers."""
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
            texels_per_metre = ready.uv_per_metre * max(texture.shape[:2]) / stretch
            level = self._texture(texture, texels_per_metre * float(np.median(hit.t)) / K[0, 0])
            uv = _blend(ready.uv, hit.face, corner)
            color = sample_texture(level, uv[:, 0], uv[:, 1])
        if ready.colors is not None:
            color = color * _blend(ready.colors, hit.face, corner)
        albedo.reshape(-1, 3)[hit.pixel] = color

    def _paint_plane(
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
        R, origin = plane.camera_from_plane[:3, :3].astype(np.float32), plane.camera_from_plane[:3, 3].astype(np.float32)
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
        albedo.reshape(-1, 3)[pixel] = sample_texture(self._texture(plane.texture, density), a / plane.tile, b / plane.tile)


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


def light(seen: Surfaces, rays: np.ndarray, lights: Lights, shadow: np.ndarray | None = None) -> np.ndarray:
    """Light the surfaces: ambient, Lambert, and a Blinn-Phong highlight of the first light.  -> (H, W, 3) float32."""
    shade = np.full(seen.depth.shape, np.float32(lights.ambient))
    highlight = np.zeros_like(shade)
    for k, (direction, strength) in enumerate(zip(lights.directions, lights.strengths, strict=True)):
        L = _unit(np.asarray(direction, np.float32))
        arriving = np.float32(strength) if k or shadow is None else np.float32(strength) * shadow
        shade += arriving * np.maximum(seen.normal @ L, 0)
        if k == 0 and lights.specular > 0:
            half = L - rays / np.linalg.norm(rays, axis=-1, keepdims=True)
            half /= np.linalg.norm(half, axis=-1, keepdims=True) + 1e-6
            glint = np.maximum((seen.normal * half).sum(-1), 0) ** np.float32(lights.shininess)
            highlight = glint * np.float32(lights.specular) * (1 if shadow is None else shadow)
    rgb = seen.albedo * shade[..., None] + highlight[..., None]
    rgb[seen.depth == 0] = lights.background
    return rgb


def render_depth(
    meshes: Sequence[Mesh],
    camera_from_object: Sequence[np.ndarray],
    K: np.ndarray,
    height: int,
    width: int,
    renderer: EmbreeRenderer | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return z-depth (H, W) float32 [m], 0 = nothing, and the index of the mesh seen (H, W) int32, -1 = none.

    camera_from_object: a (4, 4) [m] for each mesh. Pass a renderer to keep its meshes built between calls.
    """
    instances = [Instance(mesh, np.asarray(pose, np.float64)) for mesh, pose in zip(meshes, camera_from_object, strict=True)]
    return (renderer or EmbreeRenderer()).depth(instances, np.asarray(K, np.float64), height, width)


def _covered_pixels(points: np.ndarray, K: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the flat indices of the pixels that the convex hull of camera points may cover."""
    height, width = shape
    if (points[:, 2] < NEAR).all():
        return np.zeros(0, np.int64)
    if (points[:, 2] < NEAR).any():
        return np.arange(height * width)
    pixels = points[:, :2] / points[:, 2:] * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]
    pixels = np.clip(pixels, [-4.0 * width, -4.0 * height], [5.0 * width, 5.0 * height])
    low = np.maximum(np.floor(pixels.min(0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(pixels.max(0)).astype(int) + 3, [width, height])
    if (high <= low).any():
        return np.zeros(0, np.int64)
    outline = cv2.convexHull(np.round((pixels - low) * 16).astype(np.int32))
    mask = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
    cv2.fillConvexPoly(mask, outline, 1, shift=4)
    cv2.polylines(mask, [outline], True, 1, thickness=3, shift=4)  # a margin: the fill rounds
    y, x = np.nonzero(mask)
    return (y + low[1]) * width + x + low[0]


def _sphere(one: Instance, ready: _Prepared) -> tuple[np.ndarray, float]:
    """Return centre (3,) and radius of a sphere round an instance, in the camera [m]."""
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


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)
