"""Renders of one object in many rotations, as `geometry/crops.py` crops images."""

import numpy as np
import torch
from torch import Tensor

from posefilter.geometry.crops import CHANNELS
from posefilter.meshes.mesh import Mesh
from posefilter.rendering.embree import EmbreeRenderer
from posefilter.rendering.surfaces import Instance, Lights

_LIGHTS = Lights(ambient=0.7, directions=((0.0, 0.0, -1.0),), strengths=(0.3,))


def render_views(
    mesh: Mesh, rotations: Tensor, center: Tensor, view_radius: float, distance: float, side: int
) -> Tensor:
    """Render an object before nothing, in each rotation, its center ahead of the camera.

    Args:
        mesh: The object.
        rotations: (M, 3, 3) camera_from_object.
        center: (3,) its center in its own frame [m].
        view_radius: Radius of the ball about the center that fills a view [m].
        distance: Of the center [m].
        side: Of a view [px].

    Returns:
        (M, 5, side, side) float16, see `crop_views`.
    """
    focal, middle = side / 2 * distance / view_radius, (side - 1) / 2
    K = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]])
    renderer, pose = EmbreeRenderer(), np.eye(4)
    out = torch.zeros(len(rotations), CHANNELS, side, side, dtype=torch.float16)
    at = center.double().cpu().numpy()
    for view, R in zip(out, rotations.double().cpu().numpy(), strict=True):
        pose[:3, :3], pose[:3, 3] = R, np.array([0, 0, distance]) - R @ at
        picture = renderer.render([Instance(mesh, pose)], K, side, side, _LIGHTS)
        on = torch.from_numpy(picture.depth > 0)
        color = torch.from_numpy(picture.rgb).permute(2, 0, 1).clamp(0, 1) * 2 - 1
        along = (torch.from_numpy(picture.depth) - distance) / view_radius
        view[:] = torch.cat([color, along[None], torch.ones_like(along)[None]]) * on
    return out
