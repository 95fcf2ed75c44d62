"""Read OBJ, PLY and GLB files into `Mesh`."""

from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from posefilter.errors import UserError
from posefilter.geometry.rigid import move
from posefilter.meshes.atlas import merge_materials
from posefilter.meshes.glb import check_glb
from posefilter.meshes.mesh import Mesh, creased_normals, face_areas, looks_inward
from posefilter.meshes.obj import BRIGHTEST, PLAIN, Material, RawMesh, read_image, read_obj
from posefilter.meshes.ply import COLORS, open_ply

SUFFIXES = (".obj", ".ply", ".glb")
_FARTHEST = 1e6  # [m]
_ROUNDED = 1e-4  # of its size: what rounding may move of an object


def read_mesh(path: Path, name: str, scale: float = 1.0) -> Mesh:
    """Read a mesh file.

    Args:
        path: An OBJ, PLY or GLB file.
        name: Of the mesh.
        scale: Meters in the file's unit.

    Raises:
        UserError: It is missing, corrupt or empty, or its texture is missing; names the file.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise UserError(f"{path}: cannot read meshes of this kind; known are {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise UserError(f"{path}: no such mesh file")
    try:
        raw = read_obj(path) if path.suffix.lower() == ".obj" else _read_other(path)
    except UserError:
        raise
    # depending on the damage, parsers raise anything from KeyError to struct.error
    except Exception as error:
        reason = next(iter(str(error).splitlines()), "")
        raise UserError(
            f"{path}: not a readable mesh; is it cut short? ({type(error).__name__}: {reason})"
        ) from error
    return _finish(raw, path, name, scale)


def _finish(raw: RawMesh, path: Path, name: str, scale: float) -> Mesh:
    if len(raw.faces) == 0 or len(raw.vertices) == 0:
        raise UserError(f"{path}: the mesh has no triangles (is it a point cloud, or cut short?)")
    if raw.faces.min() < 0 or raw.faces.max() >= len(raw.vertices):
        raise UserError(f"{path}: a face names a vertex that is not there (is the file cut short?)")
    if raw.vertices.shape[1:] != (3,):
        raise UserError(f"{path}: vertices of {raw.vertices.shape[1:]} numbers, not three")
    if not np.isfinite(raw.vertices).all():
        raise UserError(f"{path}: vertices that are not finite numbers")
    for part in (raw.corner_uv, raw.corner_colors):
        if part is not None and not (np.abs(part) < _FARTHEST).all():
            raise UserError(f"{path}: texture coordinates or colors that are not finite numbers")
    if raw.corner_colors is not None and raw.corner_colors.shape[-1] != 3:
        raise UserError(f"{path}: colors of {raw.corner_colors.shape[-1]} numbers, not three")
    # stray vertices would spoil bounds, hull and diameter
    used, faces = np.unique(raw.faces, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int64)
    vertices = raw.vertices[used].astype(np.float64) * scale
    if np.abs(vertices).max() > _FARTHEST:
        raise UserError(f"{path}: vertices farther than {_FARTHEST:,.0f} m; mind the unit")
    size = float(np.ptp(vertices, axis=0).max())
    reach = float(np.abs(vertices).max())
    if reach * np.finfo(np.float32).eps > _ROUNDED * size > 0:
        raise UserError(
            f"{path}: an object of {size:.3g} m whose origin is {reach:,.0f} m away, which 32 bits "
            "do not resolve; move it to its origin"
        )
    if not face_areas(vertices, faces).max() > 0:
        raise UserError(f"{path}: the triangles have no area (do all vertices lie on one line?)")
    turned = looks_inward(vertices, faces)
    if turned:
        faces, raw = faces[:, ::-1], _reverse_corners(raw)
    try:
        normals = creased_normals(vertices, faces)
    except ValueError as error:
        raise UserError(f"{path}: not a readable mesh ({error})") from error
    if raw.corner_normals is not None:
        own = np.nan_to_num(raw.corner_normals, nan=0.0, posinf=0.0, neginf=0.0)
        length = np.linalg.norm(own, axis=-1, keepdims=True)
        given = own / np.maximum(length, 1e-12)
        if turned and (given * normals).sum() < 0:
            given = -given
        normals = np.where(length > 1e-6, given, normals).astype(np.float32)
    uv, texture, colors = merge_materials(raw, path)
    numbers = used if raw.numbered else np.zeros(0, np.int64)
    count = len(raw.vertices)
    return Mesh(
        *(name, vertices, faces, uv, texture, colors, normals),
        numbers=numbers,
        file_vertices=count,
    )


def _reverse_corners(raw: RawMesh) -> RawMesh:
    """Return a mesh with the corners of its faces in the reverse order."""
    parts = {name: getattr(raw, name) for name in ("corner_uv", "corner_normals", "corner_colors")}
    return raw._replace(
        faces=raw.faces[:, ::-1],
        **{name: part[:, ::-1] for name, part in parts.items() if part is not None},
    )


def _read_other(path: Path) -> RawMesh:
    """Read PLY and GLB with trimesh; the parts of a scene become one mesh."""
    if path.suffix.lower() == ".ply":
        loaded = _load_ply(path)
    else:
        check_glb(path)
        loaded = trimesh.load(path, process=False)
    known: dict[Any, Material] = {}
    raws = [_from_trimesh(part, place, path, known) for part, place in _list_parts(loaded)]
    if not raws:
        raise UserError(f"{path}: the mesh has no triangles (is it a point cloud, or cut short?)")

    def join(name: str, width: int, missing: float) -> np.ndarray | None:
        """Join what corners have; parts without get `missing`."""
        own = [getattr(raw, name) for raw in raws]
        if all(x is None for x in own):
            return None
        filled = [
            np.full((n, 3, width), missing) if x is None else x
            for x, n in zip(own, counts, strict=True)
        ]
        return np.concatenate(filled)

    counts = [len(raw.faces) for raw in raws]
    materials = {id(raw.materials[0]): raw.materials[0] for raw in raws}  # parts may share them
    numbers = {key: i for i, key in enumerate(materials)}
    starts = np.cumsum([0] + [len(raw.vertices) for raw in raws])[:-1]
    return RawMesh(
        np.concatenate([raw.vertices for raw in raws]),
        np.concatenate([raw.faces + start for raw, start in zip(raws, starts, strict=True)]),
        join("corner_uv", 2, 0.0),
        join("corner_normals", 3, 0.0),
        join("corner_colors", 3, 1.0),
        np.repeat([numbers[id(raw.materials[0])] for raw in raws], counts),
        list(materials.values()),
        # trimesh divides vertices that have several texture coordinates, and a GLB counts anew in
        # each of its parts
        path.suffix.lower() == ".ply" and _count_in_file(loaded) == len(raws[0].vertices),
    )


def _count_in_file(loaded: Any) -> int:
    """Return how many vertices a PLY file has."""
    return int(loaded.metadata.get("_ply_raw", {}).get("vertex", {}).get("length", -1))


def _list_parts(loaded: Any) -> Iterator[tuple[trimesh.Trimesh, np.ndarray]]:
    """Yield each mesh that a file shows, and the transform (4, 4) to where it shows it.

    They are no copies, which would lose normals and colors, and have a material each.
    """
    placed = [(loaded, np.eye(4))]
    if isinstance(loaded, trimesh.Scene):
        nodes = (loaded.graph[node] for node in loaded.graph.nodes_geometry)
        placed = [(loaded.geometry[name], place) for place, name in nodes]
    yield from ((shape, place) for shape, place in placed if isinstance(shape, trimesh.Trimesh))


def _load_ply(path: Path) -> Any:
    """Load a PLY file. Raises UserError unless the picture that it names can be read: trimesh would
    ignore that.
    """
    file, textures = open_ply(path)
    for name in textures:
        read_image(path.parent / name, path)
    resolver = trimesh.resolvers.FilePathResolver(str(path))
    loaded: Any = trimesh.load(file, file_type="ply", process=False, resolver=resolver)
    for element in loaded.metadata.get("_ply_raw", {}).values():
        data = element.get("data", {})
        names = data if isinstance(data, dict) else data.dtype.names or ()
        for name in COLORS & {*names}:  # trimesh would cut them off at 1
            if data[name].dtype.kind == "f" and data[name].max(initial=0.0) > BRIGHTEST:
                raise UserError(f"{path}: colors of floats above 1; write them in 8 bits")
    return loaded


def _from_trimesh(
    mesh: trimesh.Trimesh, place: np.ndarray, path: Path, known: dict[Any, Material]
) -> RawMesh:
    """Return a mesh at its place (4, 4); its material is one of those `known`, or is added."""
    # set by trimesh's readers only where the file has normals
    given = mesh._cache.cache.get("vertex_normals")
    faces = np.asarray(mesh.faces, dtype=np.int64)
    if np.linalg.det(place[:3, :3]) < 0:  # a mirror image has its corners the other way round
        faces = faces[:, ::-1]
    visual = mesh.visual
    uv = colors = None
    material = PLAIN
    linear = path.suffix.lower() == ".glb"  # factors and colors of vertices, by the format
    if isinstance(visual, trimesh.visual.TextureVisuals):
        uv = None if visual.uv is None else np.asarray(visual.uv)[faces]
        if id(visual.material) not in known:
            material = _trimesh_material(visual.material, linear)
            known[id(visual.material)] = known.setdefault(_identify(material), material)
        material = known[id(visual.material)]
        own = visual.vertex_attributes.get("color")
        colors = None if own is None else _unit(np.asarray(own))[:, :3][faces]
        if uv is None and material.image is not None and np.ptp(material.image, (0, 1)).any():
            raise UserError(f"{path}: faces without texture coordinates have a picture")
    elif visual is not None and visual.kind == "vertex":
        colors = np.asarray(visual.vertex_colors)[:, :3][faces] / 255
        material = Material(np.ones(3), None)
    elif visual is not None and visual.kind == "face":
        colors = np.asarray(visual.face_colors)[:, None, :3].repeat(3, axis=1) / 255
        if len(colors) != len(faces):  # of polygons
            raise UserError(f"{path}: {len(colors)} colors for {len(faces)} triangles; triangulate")
        material = Material(np.ones(3), None)
    if linear and colors is not None:
        colors = _encode_srgb(colors)
    vertices = move(np.asarray(mesh.vertices), place)
    normals = None if given is None else _move_normals(np.asarray(given), place)[faces]
    alike = np.zeros(len(faces), dtype=np.int64)
    return RawMesh(vertices, faces, uv, normals, colors, alike, [material])


def _move_normals(normals: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return normals where a transform moves their surface.  (V, 3), (4, 4) -> (V, 3)."""
    a, b, c = place[:3, :3].T
    # the inverse transpose but for its length, which there is of a flattened surface too
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])
    moved = normals @ cofactors * np.sign(np.linalg.det(place[:3, :3]) or 1.0)
    return moved / np.maximum(np.linalg.norm(moved, axis=1, keepdims=True), 1e-30)


def _unit(colors: np.ndarray) -> np.ndarray:
    """Return colors in [0, 1], as numbers of 8 or 16 bits may stand for them."""
    most = np.iinfo(colors.dtype).max if np.issubdtype(colors.dtype, np.integer) else 1.0
    return (colors.astype(np.float64) / most).clip(0, 1)


def _encode_srgb(linear: np.ndarray) -> np.ndarray:
    """Return colors as pictures have them.  In [0, 1], of any shape."""
    high = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, high)


def _identify(material: Material) -> Any:
    """Return what materials that look alike have in common."""
    color, image = material
    picture = None if image is None else (image.shape, sha256(image.tobytes()).digest())
    return tuple(color.tolist()), picture


def _trimesh_material(material: object, linear: bool) -> Material:
    """Return a material; a color that is `linear` is converted to sRGB."""
    factor = getattr(material, "baseColorFactor", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    color = factor
    if factor is None and image is None:
        color = getattr(material, "diffuse", None)
    color = np.ones(3) if color is None else np.asarray(color, dtype=np.float64)[:3] / 255
    color = _encode_srgb(color) if linear else color
    if image is None:
        return Material(color, None)
    if image.mode.startswith("I"):  # 16 bits, which PIL would cut off at 255
        gray = np.round(np.asarray(image, dtype=np.float64) / 257).clip(0, 255)
        return Material(color, gray.astype(np.uint8)[..., None].repeat(3, axis=2))
    return Material(color, np.asarray(image.convert("RGB")))
