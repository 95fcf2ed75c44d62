"""Distractors that look like the target: its shape with another texture, boxes of its color, and
if wanted its texture on another shape.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from posefilter.meshes.mesh import Mesh, creased_normals, sample_surface, surface_colors
from posefilter.synthetic.textures import (
    find_dominant_color,
    label,
    random_texture,
    recolor,
    to_uint8,
)


def make_lookalike(
    target: Mesh,
    name: str,
    photos: Sequence[np.ndarray],
    rng: np.random.Generator,
    own_texture: bool = False,
) -> Mesh:
    """Draw a look-alike: the target stretched and with another texture, or a printed box.

    With the target's own texture, some are the target in other proportions, or with its color
    channels permuted. A network that learns to reject these rejects the target in photographs,
    whose colors are not those of the renders.

    Args:
        target: The target's mesh.
        name: Of the new mesh.
        photos: Textures to crop from, (h, w, 3) uint8.
        rng: Source of randomness.
        own_texture: Whether four in ten have the target's texture.
    """
    kind = rng.random() if own_texture else 0.4 + 0.6 * rng.random()
    printed = target.corner_uv is not None and min(target.texture.shape[:2]) >= 16
    if printed and kind < 0.2:
        return stretch(target, name, _clear_stretch(rng), target.texture)
    if printed and kind < 0.4:
        return stretch(target, name, rng.uniform(0.7, 1.3, 3), recolor(rng, target.texture))
    if printed and kind < 0.55:
        return stretch(target, name, rng.uniform(0.7, 1.3, 3), random_texture(rng, 256, photos))
    sides = (target.bounds[1] - target.bounds[0]) * rng.uniform(0.45, 1.25, 3)
    base = find_dominant_color(_list_colors(target)) if kind < 0.85 else None
    return box(name, np.maximum(sides, 0.02), [to_uint8(label(rng, 96, base)) for _ in range(6)])


def _list_colors(mesh: Mesh) -> np.ndarray:
    """Return the colors of a mesh as a picture, (n, m, 3) uint8."""
    if mesh.corner_colors is None:
        return mesh.texture
    colors = surface_colors(mesh, *sample_surface(mesh, 4096))
    return to_uint8(colors).reshape(64, 64, 3)


def stretch(mesh: Mesh, name: str, factors: np.ndarray, texture: np.ndarray) -> Mesh:
    """Return a mesh scaled along its axes by factors (3,), with another texture."""
    normals = mesh.corner_normals / factors
    normals = normals / (np.linalg.norm(normals, axis=-1, keepdims=True) + 1e-12)
    return replace(
        mesh,
        name=name,
        vertices=mesh.vertices * factors,
        corner_normals=normals.astype(np.float32),
        texture=texture,
        symmetries=np.eye(4)[None],
    )


def box(name: str, sides: np.ndarray, faces: Sequence[np.ndarray]) -> Mesh:
    """Return a box centered on its origin with six printed faces.  sides: (3,) [m]; faces: six (n,
    n, 3) uint8.
    """
    corners, triangles, uv = [], [], []
    for k in range(6):
        axis, sign = k // 2, 1 - 2 * (k % 2)
        a, b = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3] * sign
        middle = np.eye(3)[axis] * sign
        corners += [
            (middle + x * a + y * b) * sides / 2 for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        ]
        column, row = k % 3, k // 3
        cell = ((0.02, 0.02), (0.98, 0.02), (0.98, 0.98), (0.02, 0.98))
        spots = np.array([[column + x, row + y] for x, y in cell]) / [3, 2]
        for i in ((0, 1, 2), (0, 2, 3)):
            triangles.append([4 * k + j for j in i])
            uv.append(spots[list(i)])
    # the atlas's row 0 is its bottom
    atlas = np.vstack([np.hstack(faces[3:]), np.hstack(faces[:3])])
    vertices, index = np.array(corners), np.array(triangles)
    normals = creased_normals(vertices, index)
    return Mesh(name, vertices, index, np.array(uv, np.float32), atlas, None, normals)


def _clear_stretch(rng: np.random.Generator) -> np.ndarray:
    """Draw factors (3,) of proportions that clearly differ from the target's on some axis."""
    factors = rng.uniform(0.6, 1.4, 3)
    axis = int(rng.integers(3))
    factors[axis] = rng.uniform(0.55, 0.78) if rng.random() < 0.6 else rng.uniform(1.25, 1.5)
    return factors
