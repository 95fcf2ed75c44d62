"""Builtin objects with their texture, and images of one before nothing."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from posefilter.meshes.mesh import object_model
from posefilter.meshes.store import MeshStore
from posefilter.meshes.texture import add_texture
from posefilter.rendering.embree import EmbreeRenderer
from posefilter.rendering.surfaces import Instance, Lights
from posefilter.types import ObjectModel

H, W = 120, 160
K = torch.tensor([[266.0, 0, 79.5], [0, 266.0, 59.5], [0, 0, 1]])


class Seen(NamedTuple):
    measured_color: Tensor
    measured_depth: Tensor
    intrinsics: Tensor


def load(name: str) -> ObjectModel:
    mesh = MeshStore("builtin").load(name)
    return add_texture(object_model(mesh, count=300), mesh)


def look(name: str, pose: Tensor, lights: Lights | None = None) -> Seen:
    """Return an image of a builtin object at a pose, before nothing."""
    lights = lights or Lights(0.5, ((0.4, -0.5, -0.8),), (0.5,))
    own = Instance(MeshStore("builtin").load(name), pose.double().numpy())
    picture = EmbreeRenderer().render([own], K.double().numpy(), H, W, lights)
    color = torch.from_numpy(np.ascontiguousarray(picture.rgb)).movedim(2, 0).float()
    return Seen(color.clamp(0, 1)[None], torch.from_numpy(picture.depth)[None].float(), K[None])
