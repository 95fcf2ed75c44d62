"""Read OBJ, PLY and GLB files into `Mesh`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh

from posefilter.errors import UserError
from posefilter.meshes.glb import check_glb
from posefilter.meshes.mesh import Mesh, creased_normals
from posefilter.meshes.obj import MOST_TEXELS, PLAIN, Material, RawMesh, read_image, read_obj
from posefilter.meshes.ply import open_ply

SUFFIXES = (".obj", ".ply", ".glb")
_FARTHEST = 1e6  # [m]


def read_mesh(path: Path, name: str, scale: float = 1.0) -> Mesh:
    """Read a mesh file.

    Args:
        path: An OBJ, PLY or GLB file.
        name: Of the mesh.
        scale: Meters in the file's unit.

    Raises:
        UserError: It is missing, corrupt or empty, or its texture is missing; names the file.
    """
    readers: dict[str, Callable[[Path], RawMesh]] = {
        ".obj": read_obj,
        ".ply": _read_other,
        ".glb": _read_other,
    }
    if path.suffix.lower() not in readers:
        raise UserError(f"{path}: cannot read meshes of this kind; known are {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise UserError(f"{path}: no such mesh file")
    try:
        raw = readers[path.suffix.lower()](path)
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
    if not np.isfinite(raw.vertices).all():
        raise UserError(f"{path}: vertices that are not finite numbers")
    for part in (raw.corner_uv, raw.corner_colors):
        if part is not None and not np.isfinite(part).all():
            raise UserError(f"{path}: texture coordinates or colors that are not finite numbers")
    # stray vertices would spoil bounds, hull and diameter
    used, faces = np.unique(raw.faces, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int64)
    vertices = raw.vertices[used].astype(np.float64) * scale
    if np.abs(vertices).max() > _FARTHEST:
        raise UserError(f"{path}: vertices farther than {_FARTHEST:,.0f} m; mind the unit")
    try:
        normals = creased_normals(vertices, faces)
    except ValueError as error:
        raise UserError(f"{path}: not a readable mesh ({error})") from error
    if raw.corner_normals is not None:
        length = np.linalg.norm(raw.corner_normals, axis=-1, keepdims=True)
        given = raw.corner_normals / np.maximum(length, 1e-12)
        normals = np.where(length > 1e-6, given, normals).astype(np.float32)
    uv, texture = _one_texture(raw, path)
    colors = None if raw.corner_colors is None else raw.corner_colors.astype(np.float32)
    return Mesh(name, vertices, faces, uv, texture, colors, normals)


def _one_texture(raw: RawMesh, path: Path) -> tuple[np.ndarray | None, np.ndarray]:
    """Stack all materials into one texture; a mesh of one plain color gets one pixel."""
    used = np.unique(raw.face_material)
    pictures = [_picture(raw.materials[i]) for i in used]
    if len(used) == 1 and (raw.corner_uv is None or pictures[0].shape[:2] == (1, 1)):
        return None, pictures[0][:1, :1]
    uv = np.zeros((len(raw.faces), 3, 2))
    if raw.corner_uv is not None:
        uv = raw.corner_uv.astype(np.float64)
    if len(used) == 1:
        return uv.astype(np.float32), pictures[0]
    height = max(p.shape[0] for p in pictures)
    width = max(p.shape[1] for p in pictures)
    if len(used) * height * width > MOST_TEXELS:
        raise UserError(
            f"{path}: too large: {len(used)} textures of {width}x{height} pixels; scale them down"
        )
    stack = np.concatenate([cv2.resize(p, (width, height)) for p in pictures])
    which = np.searchsorted(used, raw.face_material)
    # a stacked picture cannot repeat: fold each face back
    uv = uv - np.floor(uv.mean(axis=1, keepdims=True))
    inset = 0.5 / np.array([width, height])
    uv = uv.clip(inset, 1 - inset)
    uv[..., 1] = (uv[..., 1] + (len(used) - 1 - which)[:, None]) / len(used)
    return uv.astype(np.float32), stack


def _picture(material: Material) -> np.ndarray:
    if material.image is None:
        return np.round(material.color * 255).astype(np.uint8).reshape(1, 1, 3)
    if np.allclose(material.color, 1):
        return material.image
    return np.round(material.image * material.color).astype(np.uint8)


def _read_other(path: Path) -> RawMesh:
    """Read PLY and GLB with trimesh; the parts of a scene become one mesh."""
    if path.suffix.lower() == ".ply":
        loaded = _load_ply(path)
    else:
        check_glb(path)
        loaded = trimesh.load(path, process=False)
    parts = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
    raws = [_from_trimesh(part, path) for part in parts if isinstance(part, trimesh.Trimesh)]
    if not raws:
        raise UserError(f"{path}: the mesh has no triangles (is it a point cloud, or cut short?)")

    def join(name: str, width: int, missing: float) -> np.ndarray | None:
        """Join what corners have; parts without get `missing`."""
        own = [getattr(raw, name) for raw in raws]
        if all(x is None for x in own):
            return None
        pairs = zip(own, counts, strict=True)
        return np.concatenate(
            [np.full((n, 3, width), missing) if x is None else x for x, n in pairs]
        )

    counts = [len(raw.faces) for raw in raws]
    starts = np.cumsum([0] + [len(raw.vertices) for raw in raws])[:-1]
    return RawMesh(
        np.concatenate([raw.vertices for raw in raws]),
        np.concatenate([raw.faces + start for raw, start in zip(raws, starts, strict=True)]),
        join("corner_uv", 2, 0.0),
        join("corner_normals", 3, 0.0),
        join("corner_colors", 3, 1.0),
        np.repeat(np.arange(len(raws)), counts),
        [raw.materials[0] for raw in raws],
    )


def _load_ply(path: Path) -> Any:
    """Load a PLY file. Raises UserError unless the picture that it names can be read: trimesh would
    ignore that.
    """
    file, textures = open_ply(path)
    for name in textures:
        read_image(path.parent / name, path)
    resolver = trimesh.resolvers.FilePathResolver(str(path))
    return trimesh.load(file, file_type="ply", process=False, resolver=resolver)


def _from_trimesh(mesh: trimesh.Trimesh, path: Path) -> RawMesh:
    faces = np.asarray(mesh.faces, dtype=np.int64)
    visual = mesh.visual
    uv = colors = None
    material = PLAIN
    if isinstance(visual, trimesh.visual.TextureVisuals):
        uv = None if visual.uv is None else np.asarray(visual.uv)[faces]
        material = _trimesh_material(visual.material)
        if uv is None and material.image is not None and np.ptp(material.image, (0, 1)).any():
            raise UserError(f"{path}: faces without texture coordinates have a picture")
    elif visual is not None and visual.kind == "vertex":
        colors = np.asarray(visual.vertex_colors)[:, :3][faces] / 255
        material = Material(np.ones(3), None)
    elif visual is not None and visual.kind == "face":
        colors = np.asarray(visual.face_colors)[:, None, :3].repeat(3, axis=1) / 255
        material = Material(np.ones(3), None)
    # set by trimesh's readers only where the file has normals
    given = mesh._cache.cache.get("vertex_normals")
    normals = None if given is None else np.asarray(given)[faces]
    return RawMesh(
        np.asarray(mesh.vertices),
        faces,
        uv,
        normals,
        colors,
        np.zeros(len(faces), dtype=np.int64),
        [material],
    )


def _trimesh_material(material: object) -> Material:
    factor = getattr(material, "baseColorFactor", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    color = np.ones(3) if factor is None else np.asarray(factor, dtype=np.float64)[:3] / 255
    if image is not None and image.mode.startswith("I"):  # 16 bits, which PIL would cut off at 255
        gray = np.round(np.asarray(image, dtype=np.float64) / 257).clip(0, 255)
        return Material(color, gray.astype(np.uint8)[..., None].repeat(3, axis=2))
    if image is not None:
        return Material(color, np.asarray(image.convert("RGB")))
    diffuse = getattr(material, "diffuse", None)
    if factor is None and diffuse is not None:
        color = np.asarray(diffuse, dtype=np.float64)[:3] / 255
    return Material(color, None)
