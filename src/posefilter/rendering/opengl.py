"""Render color and depth images of meshes with OpenGL, off screen.

Optional: needs EGL and the extra `moderngl`. OpenGL's pixel (0, 0) has its center at (0.5, 0.5),
ours at (0, 0), so the principal point moves by half a pixel. Image row 0 is drawn at the bottom of
the frame buffer, so that no image has to be flipped. Shadows are cast with Embree.
"""

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from posefilter.errors import UserError, missing_package
from posefilter.meshes.mesh import Mesh
from posefilter.rendering.renderer import Renderer
from posefilter.rendering.surfaces import NEAR, Instance, Plane, Surfaces

_FAR = 100.0  # [m]
_KEPT = 128  # meshes and textures that stay on the device

_VERTEX = """
#version 330
uniform mat4 clip_from_camera; uniform mat4 camera_from_object; uniform mat3 normal_matrix;
in vec3 position; in vec3 normal; in vec2 uv; in vec3 color;
out vec3 point; out vec3 direction; out vec2 where; out vec3 tint;
void main() {
    vec4 p = camera_from_object * vec4(position, 1.0);
    point = p.xyz; direction = normal_matrix * normal; where = uv; tint = color;
    gl_Position = clip_from_camera * p;
}
"""
_FRAGMENT = """
#version 330
uniform sampler2D image; uniform float index;
in vec3 point; in vec3 direction; in vec2 where; in vec3 tint;
layout(location = 0) out vec4 surface; layout(location = 1) out vec4 shape;
void main() {
    vec3 n = normalize(direction);
    surface = vec4(texture(image, where).rgb * tint, index);
    shape = vec4(dot(n, point) > 0.0 ? -n : n, point.z);
}
"""


@dataclass(eq=False)
class _Uploaded:
    """A mesh on the device."""

    mesh: Mesh | Plane
    buffer: Any
    array: Any

    def release(self) -> None:
        """Free its memory there: an array does not free the buffer that it reads."""
        self.array.release()
        self.buffer.release()


class GLRenderer(Renderer):
    """Render with OpenGL; must not be shared between processes.

    Raises:
        UserError: moderngl or EGL is missing.
    """

    def __init__(self) -> None:
        super().__init__()
        try:
            moderngl: Any = importlib.import_module("moderngl")
        except ImportError as error:
            raise missing_package("renderer=opengl", "moderngl", "moderngl") from error
        try:
            self._gl: Any = moderngl.create_context(standalone=True, backend="egl")
        except Exception as error:
            raise UserError(
                f"renderer=opengl: no off-screen OpenGL here ({error}); install Mesa's EGL, or "
                f"use embree"
            ) from error
        self._gl.enable(moderngl.DEPTH_TEST)
        self._filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        self._program: Any = self._gl.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
        self._arrays: dict[int, _Uploaded] = {}
        self._textures: dict[int, tuple[np.ndarray, Any]] = {}
        self._targets: dict[tuple[int, int], Any] = {}

    def surfaces(
        self,
        instances: Sequence[Instance],
        K: np.ndarray,
        height: int,
        width: int,
        planes: Sequence[Plane] = (),
    ) -> Surfaces:
        """Return what each pixel sees; see `Renderer.surfaces`."""
        target = self._target(height, width)
        self._program["clip_from_camera"].write(
            _clip_from_camera(K, height, width).T.astype("f4").tobytes()
        )
        unoccluded = np.zeros(len(instances), np.int64)
        for i, one in enumerate(instances):
            self._begin(target)
            self._draw(one, i)
            unoccluded[i] = int((self._read(target, 0)[..., 3] >= 0).sum())
        self._begin(target)
        for i, one in enumerate(instances):
            self._draw(one, i)
        for plane in planes:
            self._draw_plane(plane)
        surface, shape = self._read(target, 0), self._read(target, 1)
        index = np.round(surface[..., 3]).astype(np.int32)
        albedo = np.ascontiguousarray(surface[..., :3])
        albedo[shape[..., 3] == 0] = 0
        normal = np.ascontiguousarray(shape[..., :3])
        depth = np.ascontiguousarray(shape[..., 3])
        return Surfaces(albedo, normal, depth, np.maximum(index, -1), unoccluded)

    def _target(self, height: int, width: int) -> Any:
        """Return the frame buffer of an image size."""
        if (height, width) not in self._targets:
            colors = [self._gl.texture((width, height), 4, dtype="f4") for _ in range(2)]
            self._targets[height, width] = self._gl.framebuffer(
                colors, self._gl.depth_renderbuffer((width, height))
            )
        return self._targets[height, width]

    def _begin(self, target: Any) -> None:
        """Clear the buffers: no surface is index -1 at depth 0."""
        target.use()
        target.clear(0.0, 0.0, 0.0, 0.0)
        target.color_attachments[0].write(
            np.tile(np.array([0, 0, 0, -1], np.float32), target.width * target.height).tobytes()
        )

    def _read(self, target: Any, attachment: int) -> np.ndarray:
        data = target.read(components=4, attachment=attachment, dtype="f4", alignment=1)
        return np.frombuffer(data, np.float32).reshape(target.height, target.width, 4)

    def _draw(self, one: Instance, index: int) -> None:
        pose = one.camera_from_object
        self._submit(one.mesh, _mesh_vertices, pose, np.linalg.inv(pose[:3, :3]).T, index)

    def _draw_plane(self, plane: Plane) -> None:
        pose = plane.camera_from_plane
        self._submit(plane, _plane_vertices, pose, pose[:3, :3], -1)

    def _submit(
        self, shape: Any, vertices: Any, pose: np.ndarray, normal_matrix: np.ndarray, index: int
    ) -> None:
        """Draw one shape; upload what is not on the device yet."""
        key = id(shape)
        if key not in self._arrays:
            while len(self._arrays) >= _KEPT:
                self._arrays.pop(next(iter(self._arrays))).release()
            buffer = self._gl.buffer(vertices(shape).astype("f4").tobytes())
            layout = [(buffer, "3f 3f 2f 3f", "position", "normal", "uv", "color")]
            array = self._gl.vertex_array(self._program, layout)
            self._arrays[key] = _Uploaded(shape, buffer, array)
        self._program["camera_from_object"].write(pose.T.astype("f4").tobytes())
        self._program["normal_matrix"].write(normal_matrix.T.astype("f4").tobytes())
        self._program["index"].value = float(index)
        self._texture(shape.texture).use(0)
        self._arrays[key].array.render()

    def _texture(self, texture: np.ndarray) -> Any:
        """Return a texture on the device, with its mipmap levels."""
        key = id(texture)
        if key not in self._textures:
            while len(self._textures) >= _KEPT:
                self._textures.pop(next(iter(self._textures)))[1].release()
            height, width = texture.shape[:2]
            uploaded = self._gl.texture(
                (width, height), 3, np.ascontiguousarray(texture[::-1]).tobytes(), alignment=1
            )
            uploaded.build_mipmaps()
            uploaded.filter = self._filter
            uploaded.repeat_x = uploaded.repeat_y = True
            self._textures[key] = texture, uploaded
        return self._textures[key][1]


def _clip_from_camera(K: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return OpenGL's projection (4, 4) of a pinhole camera, with image row 0 at the bottom."""
    out = np.zeros((4, 4))
    out[0, :3] = [2 * K[0, 0] / width, 2 * K[0, 1] / width, 2 * (K[0, 2] + 0.5) / width - 1]
    out[1, 1:3] = [2 * K[1, 1] / height, 2 * (K[1, 2] + 0.5) / height - 1]
    out[2, 2:] = [(_FAR + NEAR) / (_FAR - NEAR), -2 * _FAR * NEAR / (_FAR - NEAR)]
    out[3, 2] = 1
    return out


def _mesh_vertices(mesh: Mesh) -> np.ndarray:
    """Return position, normal, texture coordinate and color of each corner.  -> (3 F, 11)."""
    count = len(mesh.faces)
    uv = np.zeros((count, 3, 2)) if mesh.corner_uv is None else mesh.corner_uv
    colors = np.ones((count, 3, 3)) if mesh.corner_colors is None else mesh.corner_colors
    return np.concatenate(
        [mesh.vertices[mesh.faces], mesh.corner_normals, uv, colors], axis=-1
    ).reshape(-1, 11)


def _plane_vertices(plane: Plane) -> np.ndarray:
    """Return the same of a plane's two triangles.  -> (6, 11)."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]]) * plane.half_extent
    up = np.tile([0.0, 0.0, 1.0], (6, 1))
    return np.concatenate(
        [corners, np.zeros((6, 1)), up, corners / plane.tile, np.ones((6, 3))], axis=1
    )
