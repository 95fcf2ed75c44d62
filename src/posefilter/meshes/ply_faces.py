"""Binary PLY files with faces of several sizes, as modeling tools write them."""

import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from posefilter.meshes.polygons import Effort, triangulate

_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
# kinds of numbers, as `struct` and numpy name them
_KINDS = {
    **dict.fromkeys(("char", "int8"), "b"),
    **dict.fromkeys(("uchar", "uint8"), "B"),
    **dict.fromkeys(("short", "int16"), "h"),
    **dict.fromkeys(("ushort", "uint16"), "H"),
    **dict.fromkeys(("int", "int32"), "i"),
    **dict.fromkeys(("uint", "uint32"), "I"),
    "int64": "q",
    "uint64": "Q",
    **dict.fromkeys(("float", "float32"), "f"),
    **dict.fromkeys(("double", "float64"), "d"),
}
_CORNERS = ("vertex_indices", "vertex_index")
_MOST_ROWS = 2_000_000  # polygons that are split
_FIRST = ["vertex", "face"]  # the elements of a mesh


class _Property(NamedTuple):
    """A number, or a list, that each row of an element has."""

    name: str
    kind: str
    length: str | None  # the kind of a list's length; None: a number


class Element(NamedTuple):
    """A kind of rows: vertices, faces."""

    name: str
    rows: int
    properties: list[_Property]


_Row = Mapping[str, tuple[float, ...]]  # by property


def split_faces(header: str, body: bytes) -> tuple[str, bytes]:
    """Split the faces of a file into triangles: of a binary one where they are of several sizes, of
    a text where some are no triangles.

    Args:
        header: Of a PLY file, up to its last line.
        body: The rest.

    Returns:
        Both, changed; as they are where all faces are triangles.

    Raises:
        ValueError, struct.error: The file is cut short or broken.
    """
    form = re.search(r"^format\s+(\w+)", header, re.MULTILINE)
    if form is None or form[1] not in (*_ORDERS, "ascii"):
        return header, body
    elements = list(list_elements(header))
    if [element.name for element in elements[:2]] != _FIRST:
        return header, body
    vertex, face = elements[:2]
    if form[1] == "ascii":
        return _split_text(header, body, vertex, face)
    corners = next((p.name for p in face.properties if p.name in _CORNERS and p.length), None)
    if corners is None or any(p.length for p in vertex.properties):
        return header, body
    order = _ORDERS[form[1]]
    row = np.dtype([(p.name, order + p.kind) for p in vertex.properties])
    first = body.index(b"\n") + 1
    start = first + vertex.rows * row.itemsize
    if _has_triangles(body, start, face, corners, order):
        return header, body
    rows, stop = _read_rows(body, start, face, order)
    if all(len(one[corners]) == 3 for one in rows):
        return header, body
    table = np.frombuffer(body, row, vertex.rows, first)
    vertices = np.stack([table[axis] for axis in "xyz"], axis=1).astype(np.float64)
    split = _split_each(vertices, [one[corners] for one in rows])
    out = [
        _take(one, triangle, len(one[corners]))
        for one, triangles in zip(rows, split, strict=True)
        for triangle in triangles
    ]
    packed = b"".join(_pack(one, face, order) for one in out)
    return _count_faces(header, len(out)), body[:start] + packed + body[stop:]


def _split_each(vertices: np.ndarray, faces: Sequence[Sequence[Any]]) -> list[list[list[int]]]:
    """Return the triangles of each face, as positions within it; all faces of a size at once.

    (V, 3), the vertices' numbers of each face -> for each face its triangles, none of an edge.
    """
    alike: dict[int, list[Sequence[Any]]] = {}
    for face in faces:
        alike.setdefault(len(face), []).append(face)
    effort = Effort()
    triangles = {
        size: iter(triangulate(vertices[np.array(own, int)], effort).tolist())
        for size, own in alike.items()
        if size > 2
    }
    return [next(triangles[len(face)]) if len(face) > 2 else [] for face in faces]


def _count_faces(header: str, count: int) -> str:
    """Return a header that names another number of faces."""
    named = r"^([^\S\n]*element[^\S\n]+face[^\S\n]+)\d+"
    return re.sub(named, rf"\g<1>{count}", header, flags=re.MULTILINE)


def _split_text(header: str, body: bytes, vertex: Element, face: Element) -> tuple[str, bytes]:
    """Split the faces of a text file, as `split_faces` does.

    Faces whose corners are not the first of their numbers, or that have other lists, too, such as
    texture coordinates, are left to trimesh.
    """
    lists = [p.name in _CORNERS for p in face.properties if p.length]
    names = [p.name for p in vertex.properties]
    plain = face.properties and face.properties[0].name in _CORNERS and lists == [True]
    if not plain or any(p.length for p in vertex.properties) or not {*"xyz"} <= {*names}:
        return header, body
    lines = [line for line in body.splitlines()[1:] if line.strip()]
    faces = lines[vertex.rows : vertex.rows + face.rows]
    if all(line.split(None, 1)[0] == b"3" for line in faces):
        return header, body
    columns = [names.index(axis) for axis in "xyz"]
    table = [line.split() for line in lines[: vertex.rows]]
    vertices = np.array([[float(row[column]) for column in columns] for row in table])
    rows = [line.split() for line in faces]
    corners = [row[1 : int(row[0]) + 1] for row in rows]
    out = [
        b" ".join([b"3", *(places[i] for i in triangle), *row[len(places) + 1 :]])
        for row, places, triangles in zip(
            rows, corners, _split_each(vertices, corners), strict=True
        )
        for triangle in triangles
    ]
    first = body[: body.index(b"\n") + 1]
    after = lines[vertex.rows + face.rows :]
    text = b"\n".join([*lines[: vertex.rows], *out, *after]) + b"\n"
    return _count_faces(header, len(out)), first + text


def list_elements(header: str) -> Iterator[Element]:
    """Yield the elements of a PLY file, by its header."""
    for line in header.splitlines():
        match line.split():
            case ["element", name, count]:
                element = Element(name, int(count), [])
                yield element
            case ["property", "list", count, kind, name]:
                element.properties.append(_Property(name, _KINDS[kind], _KINDS[count]))
            case ["property", kind, name]:
                element.properties.append(_Property(name, _KINDS[kind], None))


def _has_triangles(body: bytes, at: int, face: Element, corners: str, order: str) -> bool:
    """Return whether all faces are triangles, with the same lengths of all else that they have:
    most files, in a fraction of the time.
    """
    if not face.rows:
        return True
    (first,), _ = _read_rows(body, at, face._replace(rows=1), order)
    fields: list[Any] = []
    for name, kind, length in face.properties:
        fields += [(f"{name} count", order + length)] if length is not None else []
        fields.append((name, order + kind, (len(first[name]),)))
    row = np.dtype(fields)
    if len(body) < at + face.rows * row.itemsize:
        return False
    table = np.frombuffer(body, row, face.rows, at)
    lists = [p.name for p in face.properties if p.length is not None]
    same = all((table[f"{name} count"] == len(first[name])).all() for name in lists)
    return len(first[corners]) == 3 and same


def _read_rows(body: bytes, at: int, element: Element, order: str) -> tuple[list[_Row], int]:
    """Return an element's rows, and where what comes after them begins."""
    if element.rows > _MOST_ROWS:
        raise ValueError(f"{element.rows:,} faces; make them triangles")
    rows: list[_Row] = []
    for _ in range(element.rows):
        row: dict[str, tuple[float, ...]] = {}
        for name, kind, length in element.properties:
            number = 1
            if length is not None:
                (number,) = struct.unpack_from(order + length, body, at)
                at += struct.calcsize(length)
            form = f"{order}{number}{kind}"
            row[name] = struct.unpack_from(form, body, at)
            at += struct.calcsize(form)
        rows.append(row)
    return rows, at


def _take(row: _Row, triangle: list[int], size: int) -> _Row:
    """Return a face's row for one of its triangles.

    Args:
        row: Of a polygon.
        triangle: Which of its corners.
        size: How many it has.
    """
    out = {}
    for name, values in row.items():
        width = len(values) // size if len(values) % size == 0 else 0
        # corners, and what each of them has, such as texture coordinates
        own = [values[width * corner + i] for corner in triangle for i in range(width)]
        out[name] = tuple(own) if width else values
    return out


def _pack(row: _Row, element: Element, order: str) -> bytes:
    out = b""
    for name, kind, length in element.properties:
        values = row[name]
        if length is not None:
            out += struct.pack(order + length, len(values))
        out += struct.pack(f"{order}{len(values)}{kind}", *values)
    return out
