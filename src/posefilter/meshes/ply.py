"""A PLY file's header, put such that trimesh finds colors and texture; and mixed polygons split."""

import io
import re
from pathlib import Path

from posefilter.errors import UserError
from posefilter.limits import read_bytes
from posefilter.meshes.ply_faces import list_elements, split_faces

_END = b"end_header"
_LONGEST = 1 << 20  # of a header [bytes]
_TEXTURE = re.compile(r"comment\s+texturefile\s+(.+)", re.IGNORECASE)
# by blanks that are no ends of lines, and none twice in a row: else the time grows by the square
_PROPERTY = re.compile(r"^([^\S\n]*property\b.*[^\S\n])(\w+)([^\S\n]*)$", re.MULTILINE)
COLORS, _WIDE = {"red", "green", "blue"}, ("h", "H")
_SHORT = {"r": "red", "g": "green", "b": "blue"}
_COORDINATES = ("texture_u", "texture_v", "u", "v", "s", "t", "texcoord")


def _decode(name: str) -> str:
    """Return a file's name that was read as Latin-1, in UTF-8 where it is that."""
    try:
        return name.encode("latin-1").decode("utf-8")
    except UnicodeDecodeError:
        return name


def open_ply(path: Path) -> tuple[io.BytesIO, list[str]]:
    """Open a PLY file for trimesh, which looks for colors under one name alone, and not at all
    where there are texture coordinates, and takes a binary file's faces to be all of one size.

    A mesh with both a texture and colors has its texture, as BOP's models of YCB-Video have both.

    Args:
        path: The file.

    Returns:
        The file, its header changed; and the picture that it names, if any.

    Raises:
        UserError: It names several pictures, of which trimesh would put one on all faces; or one,
            and has neither texture coordinates nor colors.
    """
    data = read_bytes(path)
    end = data.find(_END, 0, _LONGEST)
    if end < 0:  # trimesh says what is wrong
        return io.BytesIO(data), []
    header = data[:end].decode("latin-1")
    lines = map(_TEXTURE.fullmatch, map(str.strip, header.splitlines()))
    textures = list(dict.fromkeys(_decode(found[1].strip()) for found in lines if found))
    if len(textures) > 1:
        raise UserError(
            f"{path}: names {len(textures)} textures ({', '.join(textures[:4])}), of which a PLY "
            "can have one here; convert it to .obj or .glb"
        )
    header = _PROPERTY.sub(lambda m: m[1] + m[2].removeprefix("diffuse_") + m[3], header)
    if _SHORT.keys() <= {m[2] for m in _PROPERTY.finditer(header)}:
        header = _PROPERTY.sub(lambda m: m[1] + _SHORT.get(m[2], m[2]) + m[3], header)
    elements = list(list_elements(header))
    properties = [one for element in elements for one in element.properties]
    names = {one.name for one in properties}
    if any(one.name in COLORS and one.kind in _WIDE for one in properties):
        raise UserError(f"{path}: colors of 16 bits, which are not read; write them in 8")
    if re.search(r"^format\s+ascii", header, re.MULTILINE):
        rows = sum(element.rows for element in elements)
        if sum(1 for line in data[end:].splitlines()[1:] if line.strip()) < rows:
            raise UserError(f"{path}: its header names {rows:,} rows, and it has fewer: cut short?")
    colored, mapped = "red" in names, bool(names & {*_COORDINATES})
    if textures and not mapped and not colored:
        raise UserError(f"{path}: names a texture ({textures[0]}), but no texture coordinates")
    if not textures:  # coordinates of no picture would hide the colors
        header = _PROPERTY.sub(
            lambda m: m[1] + ("unused_" if m[2] in _COORDINATES else "") + m[2] + m[3], header
        )
    header, body = split_faces(header, data[end:])
    return io.BytesIO(header.encode("latin-1") + body), textures
