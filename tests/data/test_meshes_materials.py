"""Meshes as other tools write them: concave faces, mixed faces, materials, colors, orientation."""

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from PIL import ExifTags, Image
from scipy.spatial.distance import pdist

from posefilter.errors import UserError
from posefilter.meshes import atlas, ply_faces
from posefilter.meshes.files import read_mesh
from posefilter.meshes.mesh import (
    Mesh,
    diameter,
    face_areas,
    looks_inward,
    outline_hull,
    surface_colors,
)
from posefilter.meshes.polygons import triangulate

MIDDLE = np.array([[0.4, 0.3, 0.3]])


def _area(points: np.ndarray) -> float:
    """Return a flat polygon's signed area.  (n, 2)."""
    x, y = points.T
    return float(0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def test_polygons_are_covered_once(rng_points: list[np.ndarray]) -> None:
    for flat in rng_points:
        points = np.column_stack([flat, np.zeros(len(flat))])
        (triangles,) = triangulate(points[None])
        areas = [_area(flat[one]) for one in triangles]
        assert min(areas) >= -1e-12
        assert sum(areas) == pytest.approx(_area(flat))


@pytest.fixture
def rng_points() -> list[np.ndarray]:
    """Return star-shaped polygons of 4 to 30 corners, and a square with a hole, cut open."""
    rng = np.random.default_rng(0)
    stars = [np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 1), (1, 2), (0, 2)], dtype=float)]
    for count in range(4, 31):
        angles = (np.arange(count) + 0.8 * rng.random(count)) / count * 2 * np.pi
        radius = 0.2 + rng.random(count)
        stars.append(np.stack([radius * np.cos(angles), radius * np.sin(angles)], axis=1))
    outer = [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0)]
    inner = [(1, 1), (1, 3), (3, 3), (3, 1), (1, 1)]
    return [*stars, np.array([*outer, *inner], dtype=float)]


def test_a_concave_face_of_an_obj_has_its_area_and_texture(tmp_path: Path) -> None:
    corners = [(0, 0), (2, 0), (2, 2), (1, 0.5)]  # the last one turns back; a fan would cross it
    lines = [f"v {x} {y} 0\nvt {x / 2} {y / 2}" for x, y in np.roll(corners, 1, axis=0).tolist()]
    (tmp_path / "a.obj").write_text("\n".join([*lines, "f 2/2 3/3 4/4 1/1", ""]))
    mesh = read_mesh(tmp_path / "a.obj", "a")
    assert face_areas(mesh.vertices, mesh.faces).sum() == pytest.approx(_area(np.array(corners)))
    np.testing.assert_allclose(mesh.corner_normals, [[[0, 0, 1]] * 3] * 2)
    assert mesh.corner_uv is None  # one color
    Image.fromarray(np.eye(4, dtype=np.uint8)[..., None].repeat(3, 2)).save(tmp_path / "p.png")
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd p.png\n")
    text = (tmp_path / "a.obj").read_text()
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nusemtl m\n" + text)
    mesh = read_mesh(tmp_path / "a.obj", "a")
    assert mesh.corner_uv is not None
    np.testing.assert_allclose(2 * mesh.corner_uv, mesh.vertices[mesh.faces][..., :2])


def test_concave_faces_without_end_are_refused(tmp_path: Path) -> None:
    angles = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    radius = 1 + 0.5 * (np.arange(4000) % 2)
    lines = [f"v {r * np.cos(a)} {r * np.sin(a)} 0" for r, a in zip(radius, angles, strict=True)]
    face = "f " + " ".join(map(str, range(1, 4001)))
    (tmp_path / "a.obj").write_text("\n".join([*lines, face, ""]))
    with pytest.raises(UserError, match="concave faces of 4,000 corners; triangulate them"):
        read_mesh(tmp_path / "a.obj", "a")


def test_faces_before_the_first_material_have_none(tmp_path: Path) -> None:
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 1 0 0\n")
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    faces = ["f 1 3 2\nf 1 2 4\n", "f 1 4 3\nf 2 3 4\n"]
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{corners}{faces[0]}usemtl red\n{faces[1]}")
    mesh = read_mesh(tmp_path / "a.obj", "a")
    colors = surface_colors(mesh, np.arange(4), np.full((4, 3), 1 / 3))
    np.testing.assert_allclose(colors[:2], 0.7, atol=0.01)
    np.testing.assert_allclose(colors[2:], [[1, 0, 0]] * 2)


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_ply_with_faces_of_several_sizes(order: str, tmp_path: Path) -> None:
    vertices = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 0.5, 1), (2, 0, 0), (2, 1, 0)]
    faces = [((0, 1, 2, 3), 7), ((1, 0, 4), 8), ((1, 5, 6, 2), 9), ((2, 1), 10)]
    ending = {"<": "little", ">": "big"}[order]
    header = (
        f"ply\nformat binary_{ending}_endian 1.0\nelement vertex 7\nproperty float x\n"
        "property float y\nproperty float z\nelement face 4\n"
        "property list uchar int vertex_indices\nproperty uchar flags\n"
        "property list uchar float texcoord\nelement edge 1\nproperty int vertex1\n"
        "property int vertex2\nend_header\n"
    )
    body = b"".join(struct.pack(order + "3f", *v) for v in vertices)
    for corners, flag in faces:
        uv = [x for corner in corners for x in vertices[corner][:2]]
        body += struct.pack(f"{order}B{len(corners)}iB", len(corners), *corners, flag)
        body += struct.pack(f"{order}B{len(uv)}f", len(uv), *uv)
    body += struct.pack(order + "2i", 0, 1)
    file = tmp_path / "a.ply"
    file.write_bytes(header.encode() + body)
    mesh = read_mesh(file, "a")
    want = [[0, 1, 2], [0, 2, 3], [1, 0, 4], [1, 5, 6], [1, 6, 2]]
    np.testing.assert_allclose(mesh.vertices[mesh.faces], np.array(vertices)[want])
    file.write_bytes(header.encode() + body[:-30])
    with pytest.raises(UserError, match="cut short"):
        read_mesh(file, "a")


def _write_text(path: Path, lines: str) -> Path:
    path.write_text(lines)
    return path


CORNERS = "v 0 0 0 {0}\nv 1 0 0 {0}\nv 0 1 0 {0}\nvt 0 0\nvt 1 0\nvt 0 1\n"


def test_vertex_colors_of_an_obj_are_as_they_are(tmp_path: Path) -> None:
    path = _write_text(tmp_path / "a.obj", CORNERS.format("1 0.5 0") + "f 1 2 3\n")
    colors = surface_colors(read_mesh(path, "a"), np.array([0]), MIDDLE)
    np.testing.assert_allclose(colors, [[1, 0.5, 0]], atol=1e-6)


def test_a_picture_that_says_it_is_turned_is_read_as_it_is_stored(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 3  # upside down
    stored = np.zeros((16, 32, 3), np.uint8)
    stored[:8] = 200
    Image.fromarray(stored).save(tmp_path / "p.jpg", exif=exif)
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd p.jpg\n")
    text = "mtllib a.mtl\n" + CORNERS.format("") + "usemtl m\nf 1/1 2/2 3/3\n"
    path = _write_text(tmp_path / "a.obj", text)
    np.testing.assert_allclose(read_mesh(path, "a").texture, stored, atol=3)


@pytest.mark.parametrize(
    "material",
    [
        "Kd 2 -1 0\n",
        "map_Ka p.png\nKd 2 -1 0\n",
        "map_Kd -clamp on -bm 1.0 -s 1 1 1 my\\p 1.png\n",
        "map_Kd -o 0 0 0 p.png\n",
        "map_Ka missing.png\nmap_Kd p.png\n",
        "map_Ka p.png\nKd 0.8 0.8 0.8\n",
    ],
)
def test_materials_of_other_exporters_are_read(material: str, tmp_path: Path) -> None:
    (tmp_path / "my").mkdir()
    picture = _save(tmp_path / "my" / "p 1.png", 16, 16)
    assert cv2.imwrite(str(tmp_path / "p.png"), picture[..., ::-1])
    (tmp_path / "a.mtl").write_text("newmtl other\nKd 0 0 1\n")
    (tmp_path / "b.mtl").write_bytes(f"newmtl m\n{material}".replace("\n", "\r\n").encode())
    text = "mtllib a.mtl b.mtl\n" + CORNERS.format("") + "usemtl m\nf 1/1 2/2 \\\n3/3 # a face\n"
    path = tmp_path / "a.obj"
    path.write_bytes(text.replace("\n", "\r\n").encode())
    mesh = read_mesh(path, "a")
    if "Kd 2" in material:
        assert mesh.texture.tolist() == [[[255, 0, 0]]]
    else:
        np.testing.assert_array_equal(mesh.texture, picture)


@pytest.mark.parametrize("line", ['mtllib "my a.mtl"', "MTLLIB my a.mtl", "mtllib my a.mtl"])
def test_a_material_file_may_be_quoted_and_its_keyword_large(line: str, tmp_path: Path) -> None:
    (tmp_path / "my a.mtl").write_text("newmtl m\nKd 1 0 0\n")
    (tmp_path / "a.obj").write_text(f"{line}\n{CORNERS.format('')}Usemtl m\nf 1/1 2/2 3/3\n")
    assert read_mesh(tmp_path / "a.obj", "a").texture.tolist() == [[[255, 0, 0]]]


@pytest.mark.parametrize(
    ("material", "message"),
    [
        ("map_Kd -s 2 2 1 p.png", "map_Kd with -s"),
        ("map_Kd -o 0.5 0 0 p.png", "map_Kd with -o"),
        ("Kd", "Kd of material 'm' should have three numbers"),
        ("Kd 1 nan 0", "Kd of material 'm' should have three numbers"),
    ],
)
def test_materials_that_would_look_otherwise_are_refused(
    material: str, message: str, tmp_path: Path
) -> None:
    _save(tmp_path / "p.png", 16, 16)
    (tmp_path / "a.mtl").write_text(f"newmtl m\n{material}\n")
    text = "mtllib a.mtl\n" + CORNERS.format("") + "usemtl m\nf 1/1 2/2 3/3\n"
    with pytest.raises(UserError, match=rf"a\.mtl: {message}"):
        read_mesh(_write_text(tmp_path / "a.obj", text), "a")


def test_normals_that_are_no_numbers_are_made_anew(tmp_path: Path) -> None:
    text = CORNERS.format("") + "vn inf 0 0\nf 1//1 2//1 3//1\n"
    mesh = read_mesh(_write_text(tmp_path / "a.obj", text), "a")
    np.testing.assert_allclose(mesh.corner_normals, [[[0, 0, 1]] * 3])


PLY = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
    "property float z\n{0}element face {1}\nproperty list uchar int vertex_indices\n{2}end_header\n"
)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("brightest", [1.0, 255.0])
def test_float_colors_of_a_ply_are_shares(encoding: str, brightest: float, tmp_path: Path) -> None:
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "red", "green", "blue"))
    head = f"ply\nformat {encoding} 1.0\nelement vertex 3\n{names}element face 1\n"
    head += "property list uchar int vertex_indices\nend_header\n"
    rows = np.hstack([np.eye(3), np.tile([brightest, brightest / 2, 0], (3, 1))]).astype("<f4")
    text = "".join(" ".join(map(str, row)) + "\n" for row in rows.tolist()) + "3 0 1 2\n"
    body = rows.tobytes() + struct.pack("<B3i", 3, 0, 1, 2)
    (tmp_path / "a.ply").write_bytes(head.encode() + (text.encode() if "asc" in encoding else body))
    if brightest > 1:
        with pytest.raises(UserError, match="colors of floats above 1"):
            read_mesh(tmp_path / "a.ply", "a")
    else:
        colors = surface_colors(read_mesh(tmp_path / "a.ply", "a"), np.array([0]), MIDDLE)
        np.testing.assert_allclose(colors, [[1, 0.5, 0]], atol=0.005)


def test_broken_text_ply_is_refused(tmp_path: Path) -> None:
    rows = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n"
    path = tmp_path / "a.ply"
    assert len(read_mesh(_write_text(path, PLY.format("", 2, "") + rows), "a").faces) == 2
    with pytest.raises(UserError, match="names 7 rows, and it has fewer"):
        read_mesh(_write_text(path, PLY.format("", 3, "") + rows), "a")
    wide = "property ushort red\nproperty ushort green\nproperty ushort blue\n"
    with pytest.raises(UserError, match="colors of 16 bits"):
        read_mesh(_write_text(path, PLY.format(wide, 2, "") + rows), "a")
    own = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    quad = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3 255 0 0\n"
    mesh = read_mesh(_write_text(path, PLY.format("", 1, own) + quad), "a")
    np.testing.assert_allclose(
        surface_colors(mesh, np.array([0, 1]), MIDDLE[[0, 0]]), [[1, 0, 0]] * 2
    )
    first = PLY.format("", 1, "").replace("property list", f"{own}property list")
    with pytest.raises(UserError, match="1 colors for 2 triangles"):
        read_mesh(
            _write_text(path, first + quad.replace("4 0 1 2 3 255 0 0", "255 0 0 4 0 1 2 3")), "a"
        )


def test_binary_triangles_are_left_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also with texture coordinates of their corners, without a look at each."""
    rows = 50_000
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\n"
        f"property float y\nproperty float z\nelement face {rows}\n"
        "property list uchar int vertex_indices\nproperty list uchar float texcoord\n"
    )
    face = struct.pack("<B3iB6f", 3, 0, 1, 2, 6, *range(6))
    body = b"end_header\n" + bytes(36) + face * rows
    read: list[int] = []
    own = ply_faces._read_rows

    def count(body: bytes, at: int, element: ply_faces.Element, order: str) -> Any:
        read.append(element.rows)
        return own(body, at, element, order)

    monkeypatch.setattr(ply_faces, "_read_rows", count)
    assert ply_faces.split_faces(header, body) == (header, body)
    assert read == [1]


def _save(path: Path, height: int, width: int) -> np.ndarray:
    """Save a smooth picture."""
    image = np.random.default_rng(height).integers(0, 256, (height, width, 3), dtype=np.uint8)
    image = cv2.GaussianBlur(image, (0, 0), 2)
    assert cv2.imwrite(str(path), image[..., ::-1])
    return image


def _alone(mesh: Mesh, face: int, uv: np.ndarray, picture: np.ndarray) -> Mesh:
    """Return one face of a mesh with a picture of its own."""
    return Mesh(
        "x", mesh.vertices, mesh.faces[[face]], uv[None], picture, None, np.zeros((1, 3, 3))
    )


def test_each_material_keeps_its_picture_and_repeats_it(tmp_path: Path) -> None:
    pictures = {
        "wide": _save(tmp_path / "wide.png", 24, 60),
        "high": _save(tmp_path / "high.png", 90, 16),
    }
    (tmp_path / "a.mtl").write_text(
        "newmtl wide\nmap_Kd wide.png\nnewmtl red\nKd 1 0.2 0\nnewmtl high\nmap_Kd high.png\n"
        "newmtl same\nmap_Kd wide.png\n"
    )
    # inside the picture; over its upper edge; over 2 copies by 3; another place of the first one
    places = {
        "wide": [(0.1, 0.1), (0.9, 0.2), (0.4, 0.8)],
        "high": [(-2.6, 0.7), (-2.3, 0.8), (-2.4, 1.4)],
        "red": [(0, 0), (7, 0), (0, 9)],
        "same": [(3.2, 5.1), (4.8, 5.3), (3.9, 7.7)],
    }
    lines = ["mtllib a.mtl", "v 0 0 0", "v 1 0 0", "v 0 1 0", "v 0 0 1"]
    for number, (name, uv) in enumerate(places.items()):
        lines += [f"vt {u} {v}" for u, v in uv]
        lines += [f"usemtl {name}", "f " + " ".join(f"{i}/{3 * number + i}" for i in (1, 2, 3))]
    (tmp_path / "a.obj").write_text("\n".join(lines) + "\n")
    mesh = read_mesh(tmp_path / "a.obj", "a")
    weights = np.random.default_rng(0).dirichlet([1, 1, 1], 200)
    for face, (name, uv) in enumerate(places.items()):
        got = surface_colors(mesh, np.full(200, face), weights)
        if name == "red":
            np.testing.assert_allclose(got, [[1, 0.2, 0]] * 200, atol=1e-6)
            continue
        picture = pictures["wide" if name == "same" else name]
        alone = _alone(mesh, face, np.array(uv, dtype=np.float32), picture)
        want = surface_colors(alone, np.zeros(200, int), weights)
        at = weights @ np.array(uv)
        # next to the edge of all copies, one has the other edge's color and the other its own
        low = np.floor(np.array(uv).min(0))
        edge = (at - low) * picture.shape[1::-1] < 1
        inner = ~edge.any(1)
        assert inner.sum() > 150
        np.testing.assert_allclose(got[inner], want[inner], atol=2e-3)


def test_a_picture_of_many_materials_is_kept_once(tmp_path: Path) -> None:
    _save(tmp_path / "p.png", 64, 64)
    names = [f"m{i}" for i in range(40)]
    (tmp_path / "a.mtl").write_text("".join(f"newmtl {n}\nmap_Kd p.png\n" for n in names))
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
        + "".join(f"usemtl {n}\nf 1/1 2/2 3/3\n" for n in names)
    )
    assert read_mesh(tmp_path / "a.obj", "a").texture.shape == (80, 80, 3)


def test_many_pictures_are_nearly_a_square(tmp_path: Path) -> None:
    names = [f"m{i}" for i in range(12)]
    for i, name in enumerate(names):
        _save(tmp_path / f"{name}.png", 60 + i, 64)
    (tmp_path / "a.mtl").write_text("".join(f"newmtl {n}\nmap_Kd {n}.png\n" for n in names))
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0.1 0.1\nvt 0.9 0\nvt 0 0.9\n"
        + "".join(f"usemtl {n}\nf 1/1 2/2 3/3\n" for n in names)
    )
    mesh = read_mesh(tmp_path / "a.obj", "a")
    height, width = mesh.texture.shape[:2]
    assert max(height, width) < 1.5 * min(height, width)
    weights = np.random.default_rng(0).dirichlet([1, 1, 1], 50)
    uv = np.array([(0.1, 0.1), (0.9, 0), (0, 0.9)], dtype=np.float32)
    for face, name in enumerate(names):
        picture = cv2.imread(str(tmp_path / f"{name}.png"))[..., ::-1]
        want = surface_colors(_alone(mesh, face, uv, picture), np.zeros(50, int), weights)
        got = surface_colors(mesh, np.full(50, face), weights)
        inner = (weights @ uv * 64 > 1).all(1)
        np.testing.assert_allclose(got[inner], want[inner], atol=2e-3)


def test_a_picture_repeated_without_end_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(atlas, "MOST_TEXELS", 1 << 20)
    _save(tmp_path / "p.png", 64, 64)
    (tmp_path / "a.mtl").write_text("newmtl a\nmap_Kd p.png\nnewmtl b\nKd 1 0 0\n")
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 90 0\nvt 0 90\n"
        "usemtl a\nf 1/1 2/2 3/3\nusemtl b\nf 1 2 3\n"
    )
    with pytest.raises(UserError, match=r"a\.obj: too large: .*repeated 8100 times; scale"):
        read_mesh(tmp_path / "a.obj", "a")


def test_materials_of_one_color_each_are_colors_of_corners(tmp_path: Path) -> None:
    (tmp_path / "a.mtl").write_text("newmtl a\nKd 0 0.2 1\nnewmtl b\nKd 1 0 0\n")
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\nusemtl b\nf 1 3 2\n"
    )
    mesh = read_mesh(tmp_path / "a.obj", "a")
    assert mesh.corner_uv is None
    colors = surface_colors(mesh, np.array([0, 1]), MIDDLE.repeat(2, axis=0))
    np.testing.assert_allclose(colors, [[0, 0.2, 1], [1, 0, 0]], atol=1e-6)


def _tetrahedron() -> trimesh.Trimesh:
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    return trimesh.Trimesh(corners, faces, process=False)


def test_colors_of_a_glb_are_linear(tmp_path: Path) -> None:
    """A viewer shows a factor of 0.216 as a gray of one half; a picture's gray as it is."""
    half = 0.2140  # of light, where sRGB has 0.5
    body = _tetrahedron()
    factor = trimesh.visual.material.PBRMaterial(baseColorFactor=[half, half, half, 1.0])
    body.visual = trimesh.visual.TextureVisuals(material=factor)
    body.export(tmp_path / "factor.glb")
    assert read_mesh(tmp_path / "factor.glb", "a").texture / 255 == pytest.approx(0.5, abs=0.005)
    body = _tetrahedron()
    body.visual.vertex_colors = np.full((4, 3), round(half * 255), np.uint8)
    body.export(tmp_path / "vertices.glb")
    mesh = read_mesh(tmp_path / "vertices.glb", "a")
    assert surface_colors(mesh, np.array([0]), MIDDLE) == pytest.approx(0.5, abs=0.005)


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_vertex_colors_of_a_glb_multiply_its_material(kind: type, tmp_path: Path) -> None:
    body = _tetrahedron()
    white = trimesh.visual.material.PBRMaterial(baseColorFactor=[1.0, 1.0, 1.0, 1.0])
    body.visual = trimesh.visual.TextureVisuals(material=white)
    colors = np.array([[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1], [1, 1, 0, 1]], dtype=np.float64)
    stored = (colors * 255).astype(np.uint8) if kind is np.uint8 else colors.astype(np.float32)
    body.visual.vertex_attributes["color"] = stored
    _export_with_colors(body, stored, tmp_path / "a.glb")
    mesh = read_mesh(tmp_path / "a.glb", "a")
    got = surface_colors(mesh, np.array([3]), MIDDLE)
    np.testing.assert_allclose(got, MIDDLE @ colors[[1, 2, 3], :3], atol=1e-6)


def _export_with_colors(body: trimesh.Trimesh, colors: np.ndarray, path: Path) -> None:
    """Write a GLB with both a material and colors of vertices, which trimesh writes as neither."""

    def add(tree: dict[str, Any]) -> None:
        tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = len(tree["accessors"])
        tree["bufferViews"].append({"buffer": 0, "byteOffset": 0, "byteLength": 0})
        tree["accessors"].append(
            {
                "bufferView": len(tree["bufferViews"]) - 1,
                "componentType": 5121 if colors.dtype == np.uint8 else 5126,
                "normalized": colors.dtype == np.uint8,
                "count": len(colors),
                "type": "VEC4",
            }
        )

    data = body.export(file_type="glb", tree_postprocessor=add)
    # the buffer is the last chunk: the colors go to its end
    (length,) = struct.unpack_from("<I", data, 12)
    tree = json.loads(data[20 : 20 + length])
    binary = data[28 + length :]
    tree["bufferViews"][-1] |= {"byteOffset": len(binary), "byteLength": colors.nbytes}
    binary += colors.tobytes()
    tree["buffers"][0]["byteLength"] = len(binary)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


CHANGES = {
    "sparse": (lambda t: t["accessors"][0].update(sparse={}), "sparse array"),
    "fan": (lambda t: t["meshes"][0]["primitives"][0].update(mode=6), "fan of triangles"),
    "shape key": (lambda t: t["meshes"][0].update(weights=[0.0, 1.0]), "shape key that is on"),
    "skeleton": (lambda t: t["nodes"][-1].update(skin=0), "posed by a skeleton"),
    "instances": (
        lambda t: t.update(extensionsUsed=["EXT_mesh_gpu_instancing"]),
        "uses EXT_mesh_gpu_instancing",
    ),
    "second coordinates": (
        lambda t: t["materials"][0]["pbrMetallicRoughness"].update(
            baseColorTexture={"index": 0, "texCoord": 1}
        ),
        "other than the first",
    ),
    "no such picture": (
        lambda t: (
            t.update(textures=[{"source": 5}]),
            t["materials"][0]["pbrMetallicRoughness"].update(baseColorTexture={"index": 0}),
        ),
        "picture that is not there",
    ),
    "deep": (
        lambda t: t.update(nodes=[{"children": [i + 1]} for i in range(200)] + [{"mesh": 0}]),
        "more than 100 deep",
    ),
}


@pytest.mark.parametrize("what", CHANGES)
def test_a_glb_that_would_look_otherwise_is_refused(what: str, tmp_path: Path) -> None:
    body = _tetrahedron()
    white = trimesh.visual.material.PBRMaterial(baseColorFactor=[1.0, 1.0, 1.0, 1.0])
    body.visual = trimesh.visual.TextureVisuals(material=white)
    change, message = CHANGES[what]
    (tmp_path / "a.glb").write_bytes(body.export(file_type="glb"))
    read_mesh(tmp_path / "a.glb", "a")
    (tmp_path / "a.glb").write_bytes(body.export(file_type="glb", tree_postprocessor=change))
    with pytest.raises(UserError, match=message):
        read_mesh(tmp_path / "a.glb", "a")


@pytest.mark.parametrize("given", [True, False])
def test_a_closed_mesh_that_looks_inward_is_turned(given: bool, tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    lines = [f"v {x} {y} {z}" for x, y, z in ball.vertices.tolist()]
    lines += [f"vn {-x} {-y} {-z}" for x, y, z in ball.vertices.tolist()] if given else []
    corner = "{0}//{0}" if given else "{0}"
    lines += ["f " + " ".join(corner.format(i + 1) for i in f[::-1]) for f in ball.faces.tolist()]
    (tmp_path / "a.obj").write_text("\n".join(lines) + "\n")
    mesh = read_mesh(tmp_path / "a.obj", "a")
    assert not looks_inward(mesh.vertices, mesh.faces)
    outward = mesh.vertices[mesh.faces] / 0.05
    assert (mesh.corner_normals * outward).sum(-1).min() > 0.95
    # an open one may be meant so
    (tmp_path / "open.obj").write_text("\n".join(lines[:-40]) + "\n")
    some = read_mesh(tmp_path / "open.obj", "a")
    cross = trimesh.Trimesh(some.vertices, some.faces, process=False).face_normals
    assert (cross * some.vertices[some.faces].mean(1)).sum(-1).max() < 0


@pytest.mark.parametrize("noise", [0.0, 1e-4, 1e-2])
def test_the_diameter_of_a_smooth_hull_is_exact(noise: float) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(6000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points *= 1 + noise * rng.normal(size=(6000, 1))
    assert diameter(points) == pytest.approx(pdist(points).max(), rel=1e-12)


def test_the_outline_of_a_smooth_hull_is_that_of_its_outermost_vertices(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    points = trimesh.creation.icosphere(subdivisions=4, radius=0.1).vertices * [1, 0.7, 0.5]
    want = outline_hull(points)
    monkeypatch.setattr("posefilter.meshes.mesh._MOST_HULL", 1000)
    np.testing.assert_allclose(outline_hull(points), want)
