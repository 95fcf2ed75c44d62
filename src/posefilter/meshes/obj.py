"""Read Wavefront OBJ and its materials, with seams in the texture and normals of each corner."""

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from posefilter.errors import UserError
from posefilter.limits import check_picture, read_bytes
from posefilter.meshes.polygons import Effort, triangulate
from posefilter.paths import check_inside


class Material(NamedTuple):
    """A texture image and the color that it is multiplied by."""

    color: np.ndarray  # (3,) in [0, 1]
    image: np.ndarray | None  # (h, w, 3) uint8 RGB


PLAIN = Material(np.full(3, 0.7), None)
BRIGHTEST = 2.0  # of colors in [0, 1], as exporters that round or light them write
MOST_TEXELS = 1 << 28  # pixels of all textures of a mesh


class RawMesh(NamedTuple):
    """The content of a file, before its materials are merged into one texture."""

    vertices: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3)
    corner_uv: np.ndarray | None  # (F, 3, 2)
    corner_normals: np.ndarray | None  # (F, 3, 3)
    corner_colors: np.ndarray | None  # (F, 3, 3)
    face_material: np.ndarray  # (F,)
    materials: list[Material]
    numbered: bool = True  # whether vertices have the places that the file counts them by


def read_image(path: Path, source: Path) -> np.ndarray:
    """Read a texture image.

    Args:
        path: The image.
        source: The file that names it; the image must be in the folder of that file.

    Returns:
        (h, w, 3) uint8 RGB.

    Raises:
        UserError: It is missing, not readable, too large, or elsewhere.
    """
    check_inside(path, source.parent)
    if not path.is_file():
        raise UserError(f"{path}: missing texture, named by {source.name}")
    data = read_bytes(path)
    check_picture(path, data)
    as_stored = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION  # as of PLY and GLB
    image = cv2.imdecode(np.frombuffer(data, np.uint8), as_stored)
    if image is None:
        raise UserError(
            f"{path}: not a readable picture (is it cut short?), named by {source.name}"
        )
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _read_mtl(path: Path, source: Path, images: dict[str, np.ndarray]) -> dict[str, Material]:
    """Read materials; their images, which others may share, are added to `images`."""
    check_inside(path, source.parent)
    if not path.is_file():
        raise UserError(f"{path}: missing material file, named by {source.name}")
    materials: dict[str, Material] = {}
    pictures: dict[str, str] = {}  # the file of each material
    ambient: dict[str, str] = {}
    name = ""
    for key, rest in _read_lines(path):
        key = key.lower()  # exporters write map_kd, too
        if key == "newmtl":
            name = rest
            materials[name] = PLAIN
            pictures.pop(name, None)
            ambient.pop(name, None)
        elif key == "kd" and name:
            color = [float(x) for x in rest.split()[:3]]
            color = color * 3 if len(color) == 1 else color  # one number is a gray
            if len(color) != 3 or not np.isfinite(color).all():
                raise UserError(f"{path}: Kd of material '{name}' should have three numbers")
            color = np.clip(color, 0, 1).tolist()
            materials[name] = materials[name]._replace(color=np.array(color))
        elif key == "map_kd" and name:
            pictures[name] = rest
        elif key == "map_ka" and name:
            ambient[name] = rest
    # some exporters write no other picture, and viewers show it; a color that is chosen stays
    gray = {name: rest for name, rest in ambient.items() if np.ptp(materials[name].color) == 0}
    for name, rest in (gray | pictures).items():
        image = path.parent / _skip_options(rest, path).replace("\\", "/")
        place = os.path.realpath(image)
        if place not in images:
            images[place] = read_image(image, path)
            pixels = sum(one.shape[0] * one.shape[1] for one in images.values())
            if pixels > MOST_TEXELS:
                raise UserError(
                    f"{path}: too large: textures of {pixels:,} pixels; scale them down"
                )
        materials[name] = materials[name]._replace(image=images[place])
    # A picture is shown as it is: exporters leave Kd at any gray beside it.
    return {k: m if m.image is None else m._replace(color=np.ones(3)) for k, m in materials.items()}


def read_obj(path: Path) -> RawMesh:
    """Parse Wavefront OBJ: v (with colors), vt, vn, f (any polygon), mtllib, usemtl."""
    numbers: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
    corners: list[tuple[int, int, int]] = []
    face_material: list[int] = []
    polygons: dict[int, list[int]] = {}  # by number of corners: the first triangle of each
    library: dict[str, Material] = {}
    read: set[str] = set()  # the files of materials
    images: dict[str, np.ndarray] = {}
    materials: dict[str | None, int] = {}
    current = 0
    for key, rest in _read_lines(path):
        key = key.lower()
        if key in numbers:
            numbers[key].append([float(x) for x in rest.split()])
        elif key == "f":
            polygon = [_corner(word, numbers) for word in rest.split()]
            if len(polygon) > 3:
                polygons.setdefault(len(polygon), []).append(len(face_material))
            for i in range(1, len(polygon) - 1):
                corners += [polygon[0], polygon[i], polygon[i + 1]]
                face_material.append(current)
        elif key == "mtllib":
            rest = rest[1:-1] if len(rest) > 2 and rest[0] == rest[-1] == '"' else rest
            several = all((path.parent / file).is_file() for file in rest.split())
            for file in rest.split() if several else [rest]:
                place = os.path.realpath(path.parent / file)
                if place not in read:  # however often it is named, and how
                    library |= _read_mtl(path.parent / file, path, images)
                    read.add(place)
        elif key == "usemtl":
            if face_material and not materials:  # the faces before have none
                materials[None] = 0
            current = materials.setdefault(rest, len(materials))
    index = np.array(corners, dtype=np.int64).reshape(-1, 3, 3)  # face, corner, (v, vt, vn)
    vertices = _rectangle(numbers["v"], 3)
    colored = len(numbers["v"]) > 0 and len(numbers["v"][0]) >= 6
    colors = _rectangle(numbers["v"], 6)[:, 3:] if colored else None
    if colors is not None and colors.max(initial=0.0) > BRIGHTEST:  # numbers of 8 bits
        colors = colors / 255
    unknown = [name for name in materials if name is not None and name not in library]
    if unknown and len(numbers["vt"]) and colors is None:
        raise UserError(
            f"{path}: its material '{unknown[0]}' is in no material file (mtllib), so that its "
            f"texture is not known"
        )
    # colors of vertices are whole by themselves
    plain = PLAIN if colors is None else PLAIN._replace(color=np.ones(3))
    known = [plain if name is None else library.get(name, plain) for name in materials]
    known = known or [*library.values(), plain][:1]
    faces = index[..., 0]
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise UserError(f"{path}: a face names a vertex that is not there (is the file cut short?)")
    effort = Effort()
    for count, firsts in polygons.items():
        _split(index, vertices, np.array(firsts), count, effort)
    return RawMesh(
        vertices,
        faces,
        _gather_uv(_rectangle(numbers["vt"], 2), index[..., 1], face_material, known, path),
        _gather(_rectangle(numbers["vn"], 3), index[..., 2]),
        None if colors is None else colors[faces].clip(0, 1),
        np.array(face_material, dtype=np.int64),
        known,
    )


_COMMENT = re.compile(r"^[ \t]*#.*$", re.MULTILINE)  # a backslash at its end joins nothing
# of a map: how many words follow an option
_OPTIONS = {
    "-blendu": 1, "-blendv": 1, "-boost": 1, "-bm": 1, "-cc": 1, "-clamp": 1, "-imfchan": 1,
    "-mm": 2, "-texres": 1, "-type": 1,
}  # fmt: skip


def _skip_options(rest: str, path: Path) -> str:
    """Return the file that a map's line names, behind its options.

    Raises UserError where these move or repeat the picture, which is not read.
    """
    words = [*re.finditer(r"\S+", rest)]
    at = 0
    while at < len(words) and (option := words[at][0]).startswith("-"):
        at += 1
        if option in ("-s", "-o", "-t"):
            count = 0
            while count < 3 and at + count < len(words) - 1 and _is_number(words[at + count][0]):
                count += 1
            neutral = 1.0 if option == "-s" else 0.0
            if any(float(word[0]) != neutral for word in words[at : at + count]):
                raise UserError(f"{path}: map_Kd with {option}, which is not read; bake it")
        elif option in _OPTIONS:
            count = _OPTIONS[option]
        else:
            return words[-1][0] if at < len(words) else ""
        at += count
    return rest[words[at].start() :] if at < len(words) else ""


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _split(
    index: np.ndarray, vertices: np.ndarray, firsts: np.ndarray, count: int, effort: Effort
) -> None:
    """Split polygons, which are fans so far, such that concave ones are covered, too; in place.

    Args:
        index: (F, 3, 3) of each triangle's corners: vertex, texture coordinates, normal.
        vertices: (V, 3).
        firsts: (M,) the first triangle of each polygon.
        count: Corners of each.
        effort: Of the file.
    """
    rows = firsts[:, None] + np.arange(count - 2)  # (M, n - 2)
    corners = np.concatenate([index[firsts, :2], index[rows, 2]], axis=1)  # (M, n, 3)
    triangles = triangulate(vertices[corners[..., 0]], effort)
    index[rows] = corners[np.arange(len(firsts))[:, None, None], triangles]


def _read_lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield keyword and rest of each line; a line that ends with a backslash goes on."""
    text = read_bytes(path).decode("utf-8-sig", errors="replace")
    text = _COMMENT.sub("", text.replace("\r\n", "\n")).replace("\\\n", " ")
    for line in text.splitlines():
        key, *rest = line.split(None, 1) or [""]
        if key.lower() in ("v", "vt", "vn", "f"):
            rest = [part.partition("#")[0] for part in rest]
        yield key, "".join(rest).strip()


def _gather_uv(
    values: np.ndarray,
    index: np.ndarray,
    face_material: Sequence[int],
    materials: Sequence[Material],
    path: Path,
) -> np.ndarray | None:
    """Return texture coordinates (F, 3, 2), 0 on faces without, whose material has one color.

    Raises UserError where it has a picture of more.
    """
    without = np.asarray((index < 0).any(axis=1) | (len(values) == 0))
    for which in np.unique(np.asarray(face_material)[without]).tolist():
        image = materials[which].image
        if image is not None and (image != image[:1, :1]).any():
            raise UserError(f"{path}: faces without texture coordinates (vt) have a picture")
    if without.all():
        return None
    return np.where(without[:, None, None], 0.0, values[np.where(without[:, None], 0, index)])


def _corner(word: str, numbers: dict[str, list[list[float]]]) -> tuple[int, int, int]:
    """Parse v, v/vt, v//vn or v/vt/vn into indices from 0; -1 where absent."""
    parts = [*word.split("/"), "", ""][:3]
    found = []
    for part, key in zip(parts, ("v", "vt", "vn"), strict=True):
        value = int(part) if part else 0
        if key != "v" and value < -len(numbers[key]):  # vertices are checked together
            raise ValueError(f"a face names {key} {value}, and there are {len(numbers[key])}")
        found.append(value - 1 if value >= 0 else len(numbers[key]) + value)
    return found[0], found[1], found[2]


def _rectangle(rows: list[list[float]], width: int) -> np.ndarray:
    return np.array([row[:width] for row in rows], dtype=np.float64).reshape(-1, width)


def _gather(values: np.ndarray, index: np.ndarray) -> np.ndarray | None:
    """Return values[index], or None where the file leaves any corner without one."""
    if len(values) == 0 or len(index) == 0 or index.min() < 0:
        return None
    return values[index]
