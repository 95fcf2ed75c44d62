"""What a filter carries of an object's texture: colored surface points, and turns that the shape
leaves open.
"""

import numpy as np
import torch
from scipy.spatial import cKDTree

from posefilter.errors import UserError
from posefilter.meshes.find_symmetries import find_symmetries
from posefilter.meshes.mesh import Mesh, sample_surface, surface_colors, surface_points
from posefilter.meshes.rotational_symmetries import ANY, make_group, select
from posefilter.types import ObjectModel

TEXTURE_POINTS = 800
_SAMPLES = 20  # of the texture, averaged at each of them
_SIDE = 0.05  # of the extent: how far apart the two sides of a thin wall count
_STEPS = 144  # of a turn by any angle: 2.5 degrees
_COARSE_STEPS = 24  # where two axes leave any angle open


def add_texture(object_model: ObjectModel, mesh: Mesh, count: int = TEXTURE_POINTS) -> ObjectModel:
    """Return the object with `count` textured points and its shape's symmetries.

    A mesh whose shape cannot be examined, such as a flat one, has no symmetries but the identity.
    """
    return object_model._replace(
        texture=torch.from_numpy(sample_texture(mesh, count)),
        shape_symmetries=torch.from_numpy(find_shape_symmetries(mesh, object_model.diameter)),
    )


def sample_texture(mesh: Mesh, count: int = TEXTURE_POINTS, seed: int = 0) -> np.ndarray:
    """Draw surface points with the mean color of the surface around each.

    Args:
        mesh: The mesh.
        count: Number of points, uniform by area.
        seed: Of the random generator.

    Returns:
        (count, 9) float32: point [m], outward unit normal, color in [0, 1].
    """
    points, normals, _ = _draw(mesh, count, seed)
    dense, dense_normals, colors = _draw(mesh, count * _SAMPLES, seed + 1)
    side = _SIDE * float(np.ptp(points, axis=0).max())
    tree = cKDTree(np.concatenate([points, side * normals], axis=1))
    nearest = tree.query(np.concatenate([dense, side * dense_normals], axis=1))[1]
    number = np.bincount(nearest, minlength=count)[:, None]
    total = np.stack([np.bincount(nearest, c, minlength=count) for c in colors.T], axis=1)
    # a point that no sample is nearest to has the color of the sample nearest to it
    own = colors[cKDTree(dense).query(points)[1]]
    mean = np.where(number > 0, total / np.maximum(number, 1), own)
    return np.concatenate([points, normals, mean], axis=1).astype(np.float32)


def find_shape_symmetries(mesh: Mesh, size: float) -> np.ndarray:
    """Return the turns that move the shape onto itself, whatever they do to the texture.

    Args:
        mesh: The mesh.
        size: Its diameter [m].

    Returns:
        (S, 4, 4) float32 object_from_object [m], the identity first.
    """
    try:
        turns = select(find_symmetries(mesh), texture=False)
    except (UserError, ValueError, np.linalg.LinAlgError):
        turns = []
    free = sum(turn.fold == ANY for turn in turns)
    return make_group(turns, size, _STEPS if free < 2 else _COARSE_STEPS).astype(np.float32)


def _draw(mesh: Mesh, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, unit normals and colors of a surface, (count, 3) each."""
    face, weights = sample_surface(mesh, count, seed)
    normals = np.einsum("pi,pic->pc", weights, mesh.corner_normals[face])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return surface_points(mesh, face, weights), normals, surface_colors(mesh, face, weights)
