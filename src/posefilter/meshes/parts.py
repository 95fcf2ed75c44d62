"""Parts of objects, such as a hammer's head and handle: declared beside the mesh, in parts.json.

A part is a set of the mesh's faces. It is used in two ways: metrics compare each part of an object
with that part at the estimated pose, and a part can be an object of its own, named `OBJECT.PART`.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from posefilter.errors import UserError
from posefilter.limits import read_json
from posefilter.meshes.mesh import Mesh

FILE = "parts.json"
_MOST_BYTES = 1 << 26  # parts may list their vertices
SEPARATOR = "."
_KINDS = "a part is {'box': [[x, y, z], [x, y, z]]} or {'vertices': [numbers]}"


def split_part(name: str) -> tuple[str, str]:
    """Return the object and the part that a name may mean: `hammer.head` is (hammer, head)."""
    base, _, part = name.rpartition(SEPARATOR)
    return (base, part) if base else (name, "")


def read_parts(file: Path, name: str, scale: float, mesh: Mesh) -> dict[str, np.ndarray]:
    """Read an object's parts.

    The file maps objects to parts, `{"hammer": {"head": {"box": [[...], [...]]}}}`; a file in the
    object's own folder may hold its parts alone. A part is an axis-aligned box (two corners, in the
    unit of the mesh file), which has the faces whose center is in it, or a list of the file's
    vertices, counted from 0, which has the faces with at least two corners in it. A face belongs to
    the first part that has it.

    Args:
        file: The file.
        name: The object.
        scale: Meters in the mesh file's unit.
        mesh: The object's mesh [m].

    Returns:
        (F,) bool by part, disjoint.

    Raises:
        UserError: The file cannot be read, or a part is none.
    """
    table = read_json(file, _MOST_BYTES)
    if not isinstance(table, dict):
        raise UserError(f"{file}: should map names to parts; {_KINDS}")
    entry = table if _is_of_one(table) else table.get(name, {})
    if not isinstance(entry, dict):
        raise UserError(f"{file}: '{name}' should map names of parts to parts; {_KINDS}")
    wholes = {part: _select(one, scale, mesh, f"{file}: {part}") for part, one in entry.items()}
    return assign(wholes, str(file))


def declares_parts(file: Path, name: str) -> bool:
    """Return whether a file in the format of `read_parts` says something of an object; one that is
    no mapping counts as such, since reading it tells why.
    """
    table = read_json(file, _MOST_BYTES)
    return not isinstance(table, dict) or name in table or _is_of_one(table)


def has_one_object(file: Path) -> bool:
    """Return whether a file in the format of `read_parts` holds the parts of one object alone, and
    does not say of which.
    """
    table = read_json(file, _MOST_BYTES)
    return isinstance(table, dict) and _is_of_one(table)


def _is_of_one(table: Mapping[str, object]) -> bool:
    """Return whether a file holds the parts of one object alone."""
    return any(
        # a part may have the name of a kind; its value is a mapping then
        isinstance(one, dict) and key in one and not isinstance(one[key], dict)
        for one in table.values()
        for key in ("box", "vertices")
    )


def assign(wholes: Mapping[str, np.ndarray], said: str) -> dict[str, np.ndarray]:
    """Return disjoint parts: a face belongs to the first that has it.

    Args:
        wholes: (F,) bool by part.
        said: Where they were declared, for messages.

    Raises:
        UserError: A part has no face, or its name does not do.
    """
    taken: np.ndarray | None = None
    out = {}
    for part, faces in wholes.items():
        if not part.replace("_", "").replace("-", "").isalnum():
            raise UserError(
                f"{said}: part '{part}': a name must consist of letters, digits, - and _"
            )
        own = faces if taken is None else faces & ~taken
        if not own.any():
            raise UserError(f"{said}: part '{part}' has no face of the mesh; mind the unit")
        taken = own if taken is None else taken | own
        out[part] = own
    return out


def take_faces(mesh: Mesh, keep: np.ndarray, name: str) -> Mesh:
    """Return some faces of a mesh, such as a part's, as a mesh in its frame, which has no
    symmetries.  keep: (F,) bool.
    """
    used, faces = np.unique(mesh.faces[keep], return_inverse=True)
    return replace(
        mesh,
        name=name,
        vertices=mesh.vertices[used],
        faces=faces.reshape(-1, 3),
        corner_uv=None if mesh.corner_uv is None else mesh.corner_uv[keep],
        corner_colors=None if mesh.corner_colors is None else mesh.corner_colors[keep],
        corner_normals=mesh.corner_normals[keep],
        symmetries=np.eye(4)[None],
        parts={},
        numbers=None if mesh.numbers is None else mesh.numbers[used],
    )


def _select(one: Any, scale: float, mesh: Mesh, said: str) -> np.ndarray:
    try:
        if set(one) == {"box"}:
            corners = np.array(one["box"], dtype=np.float64).reshape(2, 3) * scale
            if not np.isfinite(corners).all():
                raise ValueError("a corner is not finite")
            low, high = corners.min(axis=0), corners.max(axis=0)
            center = mesh.vertices[mesh.faces].mean(axis=1)
            inside: np.ndarray = ((center >= low) & (center <= high)).all(axis=1)
            return inside
        if set(one) == {"vertices"}:
            listed = np.array(one["vertices"])
            if listed.ndim != 1 or listed.dtype.kind not in "iu":
                raise ValueError("vertices are counted from 0")
            numbers = np.arange(len(mesh.vertices)) if mesh.numbers is None else mesh.numbers
            if len(numbers) == 0:
                raise ValueError(
                    "vertices of a GLB, or of a PLY with texture coordinates by face, have no "
                    "numbers that can be told; use a box"
                )
            count = mesh.file_vertices or len(numbers)  # some of which no face may use
            if len(listed) == 0 or listed.min() < 0 or listed.max() >= count:
                raise ValueError(f"the mesh has vertices 0 to {count - 1}")
            corners_in: np.ndarray = np.isin(numbers, listed)[mesh.faces].sum(axis=1) >= 2
            return corners_in
    except (TypeError, ValueError, KeyError, OverflowError) as error:
        raise UserError(f"{said}: cannot be read ({error}); {_KINDS}") from error
    raise UserError(f"{said}: {_KINDS}")
