"""The meshes that a command draws: of the objects of its checkpoints, in the right unit."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from posefilter.errors import UserError
from posefilter.figures.overlay import Shape
from posefilter.types import ObjectModel

if TYPE_CHECKING:
    from posefilter.meshes.store import MeshStore

_SAME = 1.5  # meshes of one object in one unit differ by less
_UNITS = (1.0, 0.001, 0.01, 0.0254, 1000.0)  # [m]


def open_shapes(cfg: DictConfig, objects: Sequence[str]) -> "MeshStore | None":
    """Return the meshes of `meshes=`, in the unit of `mesh_scale=` or the default of datasets; None
    where none are given.

    Raises UserError where only their unit is.
    """
    if not cfg.meshes:
        if cfg.mesh_scale is not None:
            raise UserError(
                f"mesh_scale={cfg.mesh_scale:g}: is the unit of meshes=, which is not given; the "
                "checkpoint's own hull is in meters"
            )
        return None
    # most are drawn by the hull that the checkpoint has, and need no readers of meshes
    from posefilter.data.readers.registry import default_mesh_scale
    from posefilter.meshes.store import MeshStore

    # of names alone: only BOP's own models are named obj_*
    scale = default_mesh_scale("bop", objects) if cfg.mesh_scale is None else cfg.mesh_scale
    return MeshStore(cfg.meshes, scale=scale)


def load_shape(store: "MeshStore | None", object_model: ObjectModel) -> Shape:
    """Return what to draw of an object: its mesh, or the checkpoint's hull where there are none.

    Raises:
        UserError: There is no mesh of its name, or it is of another size than the checkpoint's
            object.
    """
    if store is None:
        return object_model.hull
    from posefilter.meshes.mesh import diameter

    mesh = store.load(object_model.name)
    ratio = diameter(mesh.vertices) / object_model.diameter
    if 1 / _SAME < ratio < _SAME:
        return mesh
    fitting = [
        f"mesh_scale={unit:g}"
        for unit in _UNITS
        if abs(math.log(ratio * unit / store.scale)) < math.log(_SAME)
    ]
    cause = f"give {fitting[0]}" if fitting else "is it a mesh of another object?"
    raise UserError(
        f"meshes={store.root}: {object_model.name} is {1000 * ratio * object_model.diameter:.3g} "
        f"mm across with mesh_scale={store.scale:g}, and the checkpoint's object "
        f"{1000 * object_model.diameter:.0f} mm; {cause}"
    )
