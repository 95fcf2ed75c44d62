"""Render color and depth images of meshes with Embree, one ray for each pixel."""

from collections.abc import Sequence

import numpy as np

from posefilter.meshes.mesh import Mesh
from posefilter.rendering.raycasting import Hits
from posefilter.rendering.renderer import Renderer
from posefilter.rendering.sampling import MipmapCache, sample_texture
from posefilter.rendering.surfaces import NEAR, Instance, Plane, Surfaces, pixel_rays


class EmbreeRenderer(Renderer):
    """Render by casting one ray for each pixel; must not be shared between processes.

    Args:
        keep: The number of newest meshes that stay built.
    """

    def __init__(self, keep: int = 96) -> None:
        super().__init__(keep)
        self._mipmaps = MipmapCache()

    def surfaces(
        self,
        instances: Sequence[Instance],
        K: np.ndarray,
        height: int,
        width: int,
        planes: Sequence[Plane] = (),
    ) -> Surfaces:
        """Return what each pixel sees; see `Renderer.surfaces`."""
        rays = pixel_rays(K, height, width)
        hits, far, index = self._find_nearest(instances, rays, K)
        unoccluded = np.array([len(hit.pixel) for hit in hits], np.int64)
        albedo, normal = np.zeros((2, height, width, 3), np.float32)
        for plane in planes:
            self._write_plane(plane, rays, K, far, albedo, normal, index)
        for i, (one, hit) in enumerate(zip(instances, hits, strict=True)):
            mine = (index.reshape(-1)[hit.pixel] == i) & (hit.t == far.reshape(-1)[hit.pixel])
            self._write_instance(one, hit.keep(mine), K, rays, albedo, normal)
        return Surfaces(
            albedo, normal, np.where(np.isfinite(far), far, np.float32(0)), index, unoccluded
        )

    def depth(
        self, instances: Sequence[Instance], K: np.ndarray, height: int, width: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Render depth only.

        Returns:
            z-depth (H, W) float32 [m], 0 = nothing, and the index of the instance that is seen
            (H, W) int32, -1 = none.
        """
        _, far, index = self._find_nearest(instances, pixel_rays(K, height, width), K)
        far[index < 0] = 0
        return far, index

    def _find_nearest(
        self, instances: Sequence[Instance], rays: np.ndarray, K: np.ndarray
    ) -> tuple[list[Hits], np.ndarray, np.ndarray]:
        """Return all hits of each instance, and of each pixel the depth (H, W) [m] of the nearest,
        infinite without, and its instance (H, W), -1 without.
        """
        far = np.full(rays.shape[:2], np.inf, np.float32)
        index = np.full(rays.shape[:2], -1, np.int32)
        hits = [self.caster.cast(one, rays, K) for one in instances]
        for i, hit in enumerate(hits):
            near = hit.t < far.reshape(-1)[hit.pixel]
            far.reshape(-1)[hit.pixel[near]] = hit.t[near]
            index.reshape(-1)[hit.pixel[near]] = i
        return hits, far, index

    def _write_instance(
        self,
        one: Instance,
        hit: Hits,
        K: np.ndarray,
        rays: np.ndarray,
        albedo: np.ndarray,
        normal: np.ndarray,
    ) -> None:
        """Write an instance's color and normals into the buffers."""
        if len(hit.pixel) == 0:
            return
        mesh = self.caster.prepare(one.mesh)
        corner = np.stack([1 - hit.u - hit.v, hit.u, hit.v], axis=1)
        linear = one.camera_from_object[:3, :3]
        n = _blend(mesh.normals, hit.face, corner) @ np.linalg.inv(linear).astype(np.float32)
        n /= np.linalg.norm(n, axis=1, keepdims=True) + 1e-12
        away = (n * rays.reshape(-1, 3)[hit.pixel]).sum(1) > 0
        n[away] *= -1
        normal.reshape(-1, 3)[hit.pixel] = n
        texture = one.mesh.texture
        if mesh.uv is None:
            color = np.broadcast_to(texture[0, 0] / np.float32(255), n.shape)
        else:
            stretch = max(float(abs(np.linalg.det(linear))) ** (1 / 3), 1e-6)
            texels_per_meter = mesh.uv_per_meter * max(texture.shape[:2]) / stretch
            density = texels_per_meter * float(np.median(hit.t)) / K[0, 0]
            level = self._mipmaps.level(texture, density)
            uv = _blend(mesh.uv, hit.face, corner)
            color = sample_texture(level, uv[:, 0], uv[:, 1])
        if mesh.colors is not None:
            color = color * _blend(mesh.colors, hit.face, corner)
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
        R = plane.camera_from_plane[:3, :3].astype(np.float32)
        origin = plane.camera_from_plane[:3, 3].astype(np.float32)
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
            self._mipmaps.level(plane.texture, density), a / plane.tile, b / plane.tile
        )


def render_depth(
    meshes: Sequence[Mesh],
    camera_from_object: Sequence[np.ndarray],
    K: np.ndarray,
    height: int,
    width: int,
    renderer: EmbreeRenderer | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Render the depth of meshes.

    Args:
        meshes: The meshes.
        camera_from_object: (4, 4) [m] for each mesh.
        K: (3, 3) camera matrix [px].
        height: Of the image [px].
        width: Of the image [px].
        renderer: Given to keep its meshes built between calls.

    Returns:
        z-depth (H, W) float32 [m], 0 = nothing, and the index of the mesh that is seen (H, W)
        int32, -1 = none.
    """
    instances = [
        Instance(mesh, np.asarray(pose, np.float64))
        for mesh, pose in zip(meshes, camera_from_object, strict=True)
    ]
    return (renderer or EmbreeRenderer()).depth(instances, np.asarray(K, np.float64), height, width)


def _blend(corners: np.ndarray, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Interpolate over triangles.  (F, 3, C), (P,), (P, 3) -> (P, C)."""
    return np.einsum("pkc,pk->pc", corners[face], weights)
