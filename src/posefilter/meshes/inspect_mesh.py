"""Look at a mesh before hours are spent on it: its size, its texture, whether it is closed."""

import math
from typing import NamedTuple

import numpy as np

from posefilter.errors import UserError
from posefilter.meshes import store
from posefilter.meshes.mesh import (
    OPEN_EDGES,
    Mesh,
    diameter,
    face_areas,
    find_open_edges,
    measure_volume,
    surface_colors,
)

# [m] across: what is larger or smaller is likely in another unit than meters
LARGEST, SMALLEST = 2.0, 0.01
_COMMON = 0.2  # [m] likely units are told in the order of how near they come to it
_COARSE = 0.5  # [px / mm] of texture


class MeshFacts(NamedTuple):
    """What is known of a mesh."""

    diameter_mm: float  # largest distance between two points
    size_mm: tuple[float, float, float]  # of the box along the file's axes
    faces: int
    open_edges: float  # share of the edges that do not belong to two triangles
    volume_cm3: float  # of a closed surface
    texture_px_per_mm: float  # of the texture on the surface; 0 without texture
    colored: bool  # whether texture or vertices have more than one color


def inspect_mesh(mesh: Mesh) -> MeshFacts:
    """Measure a mesh."""
    low, high = mesh.bounds
    resolution = 0.0
    if mesh.corner_uv is not None and max(mesh.texture.shape[:2]) > 1:
        size = np.array(mesh.texture.shape[1::-1])
        sides = (mesh.corner_uv[:, 1:] - mesh.corner_uv[:, :1]).astype(np.float64) * size
        u, v = sides[:, 0], sides[:, 1]
        pixels = 0.5 * np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum()
        area = face_areas(mesh.vertices, mesh.faces).sum()
        resolution = math.sqrt(pixels / max(area, 1e-12)) / 1000
    printed = resolution > 0 and float(mesh.texture.reshape(-1, 3).std(0).max()) > 2
    everywhere = np.arange(len(mesh.faces))
    centers = surface_colors(mesh, everywhere, np.full((len(everywhere), 3), 1 / 3))
    painted = mesh.corner_colors is not None and float(mesh.corner_colors.std()) > 0.01
    several = float(centers.std(0).max()) > 0.01  # materials of one color each
    x, y, z = (1000 * (high - low)).tolist()
    return MeshFacts(
        1000 * diameter(mesh.vertices),
        (x, y, z),
        len(mesh.faces),
        find_open_edges(mesh.vertices, mesh.faces),
        1e6 * measure_volume(mesh.vertices, mesh.faces),
        resolution,
        printed or painted or several,
    )


def check_size(facts: MeshFacts, source: str) -> None:
    """Raise UserError, naming the unit that would fit, where an object cannot be so large or small.

    Args:
        facts: Of the mesh as it was read, its file's unit taken as meters.
        source: The file, for the message.
    """
    across = facts.diameter_mm / 1000
    if SMALLEST <= across <= LARGEST:
        return
    nearest = sorted(
        store.UNITS.items(), key=lambda unit: abs(math.log(across * unit[1] / _COMMON))
    )
    fitting = [
        f"mesh_scale={scale:g} ({unit}: {1000 * across * scale:.0f} mm across)"
        for unit, scale in nearest
        if SMALLEST <= across * scale <= LARGEST
    ]
    advice = f"is it {' or '.join(fitting)}?" if fitting else "is the file damaged?"
    if store.SMALLEST <= across <= store.LARGEST:  # else that is refused, too
        advice += " If it is right, give mesh_scale=1"
    raise UserError(f"{source}: {across:.3g} m across; {advice}")


def list_concerns(facts: MeshFacts) -> list[str]:
    """Return what may spoil renders of a mesh, a sentence each."""
    out = []
    if facts.open_edges > OPEN_EDGES:
        share = 100 * facts.open_edges
        out.append(
            f"The surface is not closed ({share:.0f} % of its edges do not belong to two faces): "
            "renders may show its inside."
        )
    if not facts.colored:
        out.append("It has one color: what is printed on the real object is not learned.")
    elif 0 < facts.texture_px_per_mm < _COARSE:
        out.append(
            f"The texture is coarse ({facts.texture_px_per_mm:.2f} pixels a millimeter): small "
            "print is not learned."
        )
    return out
