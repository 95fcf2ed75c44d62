"""What a GLB file of somebody else may hold: checked before its reader makes arrays of it.

The reader believes the file's own counts: an accessor without a buffer is filled with as many zeros
as it says, a node that is listed twice is copied for each, and so is what is below it.
"""

import json
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from posefilter.errors import UserError
from posefilter.limits import check_picture, read_bytes
from posefilter.meshes.obj import MOST_TEXELS

MOST_ELEMENTS = 1 << 24  # of an accessor, and of all that the nodes show
_MOST_NODES = 10_000
_MOST_JSON = 1 << 24  # [bytes]
# extensions that change neither the shape nor the picture on it
_HARMLESS = {"KHR_materials_unlit", "KHR_materials_specular", "KHR_materials_ior"}
# those that change it without being required
_CHANGING = {"KHR_texture_transform", "EXT_mesh_gpu_instancing"}
_FAN, _FLOAT, _USHORT = 6, 5126, 5123  # a kind of primitive, and kinds of numbers
_DEEPEST = 100  # nodes within each other
_JSON, _BINARY = 0x4E4F534A, 0x004E4942  # kinds of chunks


def check_glb(path: Path) -> None:
    """Check a GLB file's claims.

    Raises:
        UserError: It is no GLB, names other files, claims more than meshes have, its nodes are no
            tree, or a texture has too many pixels.
    """
    data = read_bytes(path)
    chunks = dict(_chunks(data))
    if _JSON not in chunks or len(chunks[_JSON]) > _MOST_JSON:
        raise UserError(f"{path}: no GLB file, or one with too long a header")
    try:
        content = json.loads(chunks[_JSON])
        _check_extensions(content, path)
        _check_counts(content, path)
        _check_nodes(content, path)
        _check_surfaces(content, path)
        _check_images(content, chunks.get(_BINARY, b""), path)
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError) as error:
        raise UserError(f"{path}: a broken GLB file ({type(error).__name__}: {error})") from error


def _chunks(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield (kind, content) of each chunk; nothing where the file is none or cut short."""
    if data[:4] != b"glTF":
        return
    at = 12
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<II", data, at)
        yield kind, data[at + 8 : at + 8 + length]
        at += 8 + length


def _check_extensions(content: Mapping[str, Any], path: Path) -> None:
    """Refuse what the reader would leave out without a word."""
    needed = set(content.get("extensionsRequired", ())) - _HARMLESS
    moved = _CHANGING & set(content.get("extensionsUsed", ()))
    for name in sorted(needed | moved):
        raise UserError(f"{path}: uses {name}, which is not read; export it without")
    shown = (*content.get("nodes", []), *content.get("meshes", []))
    if any(any(one.get("weights", ())) for one in shown):
        raise UserError(f"{path}: has a shape key that is on, which is not read; apply it first")
    if any("skin" in node for node in content.get("nodes", [])):
        raise UserError(f"{path}: is posed by a skeleton, which is not read; apply it first")


def _check_counts(content: Mapping[str, Any], path: Path) -> None:
    for part in ("buffers", "images"):
        for one in content.get(part, []):
            if "uri" in one:
                raise UserError(f"{path}: its {part} are in other files; embed them")
    for accessor in content.get("accessors", []):
        if "sparse" in accessor:
            raise UserError(f"{path}: has a sparse array, which is not read; export it without")
        if not 0 <= accessor["count"] <= MOST_ELEMENTS:
            raise UserError(f"{path}: too large: {accessor['count']:,} elements in one array")


def _check_nodes(content: Mapping[str, Any], path: Path) -> None:
    """Check that each node has at most one parent, and that what they show together is bounded."""
    nodes = content.get("nodes", [])
    parents = Counter(child for node in nodes for child in node.get("children", []))
    if len(nodes) > _MOST_NODES or any(count > 1 for count in parents.values()):
        raise UserError(f"{path}: its nodes are no tree, or more than {_MOST_NODES:,}")
    level = [i for i in range(len(nodes)) if i not in parents]
    for _ in range(_DEEPEST):
        level = [child for i in level for child in nodes[i].get("children", [])]
    if level:
        raise UserError(f"{path}: its nodes are more than {_DEEPEST} deep")
    meshes, accessors = content.get("meshes", []), content.get("accessors", [])
    shown = 0
    for node in nodes:
        for part in meshes[node["mesh"]]["primitives"] if "mesh" in node else []:
            places = (*part.get("attributes", {}).values(), part.get("indices"))
            shown += sum(accessors[place]["count"] for place in places if place is not None)
    if shown > MOST_ELEMENTS:
        raise UserError(f"{path}: too large: its nodes show {shown:,} elements")


def _check_surfaces(content: Mapping[str, Any], path: Path) -> None:
    """Refuse what the reader would show otherwise than the file means it."""
    accessors, textures = content.get("accessors", []), content.get("textures", [])
    for material in content.get("materials", []):
        gloss = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
        if gloss is not None and not {"diffuseFactor", "specularFactor"} <= set(gloss):
            raise UserError(f"{path}: uses KHR_materials_pbrSpecularGlossiness; export it without")
        base = material.get("pbrMetallicRoughness", {})
        used = base.get("baseColorTexture")
        black = not any(base.get("baseColorFactor", (1, 1, 1, 1))[:3])
        if any(material.get("emissiveFactor", ())) and (
            black or (used is None and "emissiveTexture" in material)
        ):
            raise UserError(
                f"{path}: a material has its color in what it emits, which is not read; make that "
                "its base color"
            )
        if used is None:
            continue
        if used.get("texCoord", 0) != 0:
            raise UserError(f"{path}: a picture by texture coordinates other than the first")
        source = textures[used["index"]].get("source")
        if source is not None and not 0 <= source < len(content.get("images", [])):
            raise UserError(f"{path}: names a picture that is not there")
    for mesh in content.get("meshes", []):
        for part in mesh["primitives"]:
            if part.get("mode", 4) == _FAN:
                raise UserError(f"{path}: has a fan of triangles; export it as triangles")
            places = part.get("attributes", {})
            uv, color = places.get("TEXCOORD_0"), places.get("COLOR_0")
            if uv is not None and accessors[uv]["componentType"] != _FLOAT:
                raise UserError(f"{path}: texture coordinates of whole numbers; export floats")
            wide = color is not None and accessors[color]["componentType"] == _USHORT
            if wide and "material" not in part:
                raise UserError(f"{path}: colors of 16 bits without a material; export one")


def _check_images(content: Mapping[str, Any], binary: bytes, path: Path) -> None:
    views = content.get("bufferViews", [])
    pixels = 0
    for image in content.get("images", []):
        view = views[image["bufferView"]]
        start = view.get("byteOffset", 0)
        pixels += check_picture(path, binary[start : start + view["byteLength"]])
        if pixels > MOST_TEXELS:
            raise UserError(f"{path}: too large: textures of {pixels:,} pixels; scale them down")
