"""Read OBJ, PLY and GLB files into `Mesh`.  OBJ is parsed here, so that texture seams and normals stay as written."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import trimesh

from posefilter.data.mesh import Mesh, creased_normals
from posefilter.errors import UserError

SUFFIXES = (".obj", ".ply", ".glb")


class _Material(NamedTuple):
    """A picture and the colour that it is multiplied by."""

    color: np.ndarray  # (3,) in [0, 1]
    image: np.ndarray | None  # (h, w, 3) uint8 RGB


_PLAIN = _Material(np.full(3, 0.7), None)


class _Raw(NamedTuple):
    """What a file says, before its materials are put into one picture."""

    vertices: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3)
    corner_uv: np.ndarray | None  # (F, 3, 2)
    corner_normals: np.ndarray | None  # (F, 3, 3)
    corner_colors: np.ndarray | None  # (F, 3, 3)
    face_material: np.ndarray  # (F,)
    materials: list[_Material]


def read_mesh(path: Path, name: str, scale: float = 1.0) -> Mesh:
    """Read one mesh file; `scale` turns its unit into metres.

    Raises UserError, naming the file, where it is missing, corrupt, empty, or lacks its texture.
    """
    readers: dict[str, Callable[[Path], _Raw]] = {".obj": _read_obj, ".ply": _read_other, ".glb": _read_other}
    if path.suffix.lower() not in readers:
        raise UserError(f"{path}: cannot read meshes of this kind; known are {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise UserError(f"{path}: no such mesh file")
    try:
        raw = readers[path.suffix.lower()](path)
    except UserError:
        raise
    except Exception as error:  # the file decides what breaks: parsers raise anything from KeyError to struct.error
        reason = next(iter(str(error).splitlines()), "")
        raise UserError(f"{path}: not a readable mesh; is it cut short? ({type(error).__name__}: {reason})") from error
    return _finish(raw, path, name, scale)


def _finish(raw: _Raw, path: Path, name: str, scale: float) -> Mesh:
    if len(raw.faces) == 0 or len(raw.vertices) == 0:
        raise UserError(f"{path}: the mesh has no triangles (is it a point cloud, or cut short?)")
    if raw.faces.min() < 0 or raw.faces.max() >= len(raw.vertices):
        raise UserError(f"{path}: a face names a vertex that is not there (is the file cut short?)")
    if not np.isfinite(raw.vertices).all():
        raise UserError(f"{path}: vertices that are not finite numbers")
    used, faces = np.unique(raw.faces, return_inverse=True)  # stray vertices would spoil bounds, hull and diameter
    faces = faces.reshape(-1, 3).astype(np.int64)
    vertices = raw.vertices[used].astype(np.float64) * scale
    normals = creased_normals(vertices, faces)
    if raw.corner_normals is not None:
        length = np.linalg.norm(raw.corner_normals, axis=-1, keepdims=True)
        given = raw.corner_normals / np.maximum(length, 1e-12)
        normals = np.where(length > 1e-6, given, normals).astype(np.float32)
    uv, texture = _one_texture(raw)
    colors = None if raw.corner_colors is None else raw.corner_colors.astype(np.float32)
    return Mesh(name, vertices, faces, uv, texture, colors, normals)


def _one_texture(raw: _Raw) -> tuple[np.ndarray | None, np.ndarray]:
    """Put all materials into one picture, stacked; a mesh of one plain colour gets one pixel."""
    used = np.unique(raw.face_material)
    pictures = [_picture(raw.materials[i]) for i in used]
    if len(used) == 1 and (raw.corner_uv is None or pictures[0].shape[:2] == (1, 1)):
        return None, pictures[0][:1, :1]
    uv = np.zeros((len(raw.faces), 3, 2)) if raw.corner_uv is None else raw.corner_uv.astype(np.float64)
    if len(used) == 1:
        return uv.astype(np.float32), pictures[0]
    height = max(p.shape[0] for p in pictures)
    width = max(p.shape[1] for p in pictures)
    stack = np.concatenate([cv2.resize(p, (width, height)) for p in pictures])
    which = np.searchsorted(used, raw.face_material)
    uv = uv - np.floor(uv.mean(axis=1, keepdims=True))  # a stacked picture cannot repeat: fold each face back
    inset = 0.5 / np.array([width, height])
    uv = uv.clip(inset, 1 - inset)
    uv[..., 1] = (uv[..., 1] + (len(used) - 1 - which)[:, None]) / len(used)
    return uv.astype(np.float32), stack


def _picture(material: _Material) -> np.ndarray:
    if material.image is None:
        return np.round(material.color * 255).astype(np.uint8).reshape(1, 1, 3)
    if np.allclose(material.color, 1):
        return material.image
    return np.round(material.image * material.color).astype(np.uint8)


def _read_image(path: Path, source: Path) -> np.ndarray:
    """Read a texture as (h, w, 3) uint8 RGB."""
    if not path.is_file():
        raise UserError(f"{path}: missing texture, named by {source.name}")
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise UserError(f"{path}: not a readable picture (is it cut short?), named by {source.name}")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _read_mtl(path: Path, source: Path) -> dict[str, _Material]:
    if not path.is_file():
        raise UserError(f"{path}: missing material file, named by {source.name}")
    materials: dict[str, _Material] = {}
    name = ""
    for line in path.read_text(errors="replace").splitlines():
        key, _, rest = line.strip().partition(" ")
        rest = rest.strip()
        if key == "newmtl":
            name = rest
            materials[name] = _PLAIN
        elif key == "Kd" and name:
            materials[name] = materials[name]._replace(color=np.array([float(x) for x in rest.split()[:3]]))
        elif key == "map_Kd" and name:
            file = rest.split()[-1] if rest.startswith("-") else rest  # options such as -s come before the file
            materials[name] = materials[name]._replace(image=_read_image(path.parent / file, path))
    # A picture is shown as it is: exporters leave Kd at any grey beside it.
    return {k: m if m.image is None else m._replace(color=np.ones(3)) for k, m in materials.items()}


def _read_obj(path: Path) -> _Raw:
    """Parse Wavefront OBJ: v (with colours), vt, vn, f (any polygon, as a fan), mtllib, usemtl."""
    numbers: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
    corners: list[tuple[int, int, int]] = []
    face_material: list[int] = []
    library: dict[str, _Material] = {}
    materials: dict[str, int] = {}
    current = 0
    for line in path.read_text(errors="replace").splitlines():
        key, _, rest = line.partition(" ")
        if key in numbers:
            numbers[key].append([float(x) for x in rest.split()])
        elif key == "f":
            polygon = [_corner(word, numbers) for word in rest.split()]
            for i in range(1, len(polygon) - 1):
                corners += [polygon[0], polygon[i], polygon[i + 1]]
                face_material.append(current)
        elif key == "mtllib":
            library |= _read_mtl(path.parent / rest.strip(), path)
        elif key == "usemtl":
            current = materials.setdefault(rest.strip(), len(materials))
    index = np.array(corners, dtype=np.int64).reshape(-1, 3, 3)  # face, corner, (v, vt, vn)
    vertices = _rectangle(numbers["v"], 3)
    colors = _rectangle(numbers["v"], 6)[:, 3:] if numbers["v"] and len(numbers["v"][0]) >= 6 else None
    known = [library.get(name, _PLAIN) for name in materials] or list(library.values())[:1] or [_PLAIN]
    faces = index[..., 0]
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise UserError(f"{path}: a face names a vertex that is not there (is the file cut short?)")
    return _Raw(
        vertices,
        faces,
        _gather(_rectangle(numbers["vt"], 2), index[..., 1]),
        _gather(_rectangle(numbers["vn"], 3), index[..., 2]),
        None if colors is None else colors[faces].clip(0, 1),
        np.array(face_material, dtype=np.int64),
        known,
    )


def _corner(word: str, numbers: dict[str, list[list[float]]]) -> tuple[int, int, int]:
    """Parse v, v/vt, v//vn or v/vt/vn into indices from 0; -1 where absent."""
    parts = [*word.split("/"), "", ""][:3]
    found = []
    for part, key in zip(parts, ("v", "vt", "vn"), strict=True):
        value = int(part) if part else 0
        found.append(value - 1 if value >= 0 else len(numbers[key]) + value)
    return found[0], found[1], found[2]


def _rectangle(rows: list[list[float]], width: int) -> np.ndarray:
    return np.array([row[:width] for row in rows], dtype=np.float64).reshape(-1, width)


def _gather(values: np.ndarray, index: np.ndarray) -> np.ndarray | None:
    """Return values[index], or None where the file leaves any corner without one."""
    if len(values) == 0 or len(index) == 0 or index.min() < 0:
        return None
    return values[index]


def _read_other(path: Path) -> _Raw:
    """Read PLY and GLB with trimesh; the parts of a scene become one mesh."""
    if path.suffix.lower() == ".ply":
        _check_ply_texture(path)
    loaded = trimesh.load(path, process=False)
    parts = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
    raws = [_from_trimesh(part, path) for part in parts if isinstance(part, trimesh.Trimesh)]
    if not raws:
        raise UserError(f"{path}: the mesh has no triangles (is it a point cloud, or cut short?)")
    vertex_start = np.cumsum([0] + [len(r.vertices) for r in raws])
    both_uv = [np.zeros((len(r.faces), 3, 2)) if r.corner_uv is None else r.corner_uv for r in raws]
    colors = [np.ones((len(r.faces), 3, 3)) if r.corner_colors is None else r.corner_colors for r in raws]
    normals = [np.zeros((len(r.faces), 3, 3)) if r.corner_normals is None else r.corner_normals for r in raws]
    return _Raw(
        np.concatenate([r.vertices for r in raws]),
        np.concatenate([r.faces + start for r, start in zip(raws, vertex_start[:-1], strict=True)]),
        None if all(r.corner_uv is None for r in raws) else np.concatenate(both_uv),
        np.concatenate(normals),
        None if all(r.corner_colors is None for r in raws) else np.concatenate(colors),
        np.concatenate([np.full(len(r.faces), i) for i, r in enumerate(raws)]),
        [r.materials[0] for r in raws],
    )


def _check_ply_texture(path: Path) -> None:
    """Raise UserError where the texture that a PLY's header names cannot be read: trimesh would go on without it."""
    header = path.read_bytes()[:4096].partition(b"end_header")[0].decode(errors="replace")
    for line in header.splitlines():
        if line.lower().startswith("comment texturefile "):
            _read_image(path.parent / line.split(maxsplit=2)[2].strip(), path)


def _from_trimesh(mesh: trimesh.Trimesh, path: Path) -> _Raw:
    faces = np.asarray(mesh.faces, dtype=np.int64)
    visual = mesh.visual
    uv = colors = None
    material = _PLAIN
    if isinstance(visual, trimesh.visual.TextureVisuals):
        uv = None if visual.uv is None else np.asarray(visual.uv)[faces]
        material = _trimesh_material(visual.material)
    elif visual is not None and visual.kind == "vertex":
        colors = np.asarray(visual.vertex_colors)[:, :3][faces] / 255
        material = _Material(np.ones(3), None)
    elif visual is not None and visual.kind == "face":
        colors = np.asarray(visual.face_colors)[:, None, :3].repeat(3, axis=1) / 255
        material = _Material(np.ones(3), None)
    given = mesh._cache.cache.get("vertex_normals")  # set by trimesh's readers only where the file has normals
    normals = None if given is None else np.asarray(given)[faces]
    return _Raw(np.asarray(mesh.vertices), faces, uv, normals, colors, np.zeros(len(faces), dtype=np.int64), [material])


def _trimesh_material(material: object) -> _Material:
    factor = getattr(material, "baseColorFactor", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    color = np.ones(3) if factor is None else np.asarray(factor, dtype=np.float64)[:3] / 255
    if image is not None:
        return _Material(color, np.asarray(image.convert("RGB")))
    diffuse = getattr(material, "diffuse", None)
    if factor is None and diffuse is not None:
        color = np.asarray(diffuse, dtype=np.float64)[:3] / 255
    return _Material(color, None)
