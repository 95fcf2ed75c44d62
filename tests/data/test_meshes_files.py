"""Mesh files: what is read is what was written, and what is broken is named."""

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from posefilter.errors import UserError
from posefilter.meshes.files import read_mesh
from posefilter.meshes.mesh import (
    Mesh,
    measure_volume,
    sample_surface,
    surface_colors,
    surface_points,
)

# A pyramid over a square base: corners of the base share positions, not texture coordinates.
OBJ = """mtllib a.mtl
v 0 0 0
v 0.1 0 0
v 0.1 0.1 0
v 0 0.1 0
v 0.05 0.05 0.2
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vt 0.5 0.5
vn 0 0 -1
vn 0 -1 0
usemtl m
f 1/1/1 4/4/1 3/3/1 2/2/1
f -5/2/-1 -4/1/-1 -1/5/-1
f 2/1/2 3/2/2 5/5/2
f 3/1/2 4/2/2 5/5/2
f 4/1/2 1/2/2 5/5/2
"""


def _picture(path: Path, size: int = 16) -> np.ndarray:
    image = np.random.default_rng(4).integers(0, 256, (size, size, 3), dtype=np.uint8)
    image = cv2.GaussianBlur(image, (0, 0), 2)
    assert cv2.imwrite(str(path), image[..., ::-1])
    return image


@pytest.fixture
def pyramid(tmp_path: Path) -> Path:
    _picture(tmp_path / "pic ture.png")
    (tmp_path / "a.mtl").write_text("newmtl m\nKd 0.8 0.8 0.8\nmap_Kd pic ture.png\n")
    (tmp_path / "a.obj").write_text(OBJ)
    return tmp_path / "a.obj"


def test_obj_keeps_polygons_seams_and_normals(pyramid: Path) -> None:
    mesh = read_mesh(pyramid, "a")
    assert len(mesh.vertices) == 5
    assert mesh.faces.tolist() == [[0, 3, 2], [0, 2, 1], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
    assert mesh.corner_uv is not None
    # the face in negative indices
    assert mesh.corner_uv[2].tolist() == [[1, 0], [0, 0], [0.5, 0.5]]
    assert mesh.corner_uv[0, 0].tolist() == [0, 0]  # the same vertex in another face
    assert mesh.corner_normals[0].tolist() == [[0, 0, -1]] * 3
    assert mesh.corner_normals[2].tolist() == [[0, -1, 0]] * 3
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume == pytest.approx(
        0.1 * 0.1 * 0.2 / 3
    )
    picture = cv2.imread(str(pyramid.parent / "pic ture.png"))[..., ::-1]
    assert np.array_equal(mesh.texture, picture)  # as it is, in RGB: Kd beside a picture is ignored


def test_scale_turns_units_into_meters(pyramid: Path) -> None:
    assert np.allclose(
        read_mesh(pyramid, "a", scale=0.5).vertices, read_mesh(pyramid, "a").vertices * 0.5
    )


def test_stray_vertices_are_left_out(pyramid: Path) -> None:
    pyramid.write_text(OBJ + "v 50 50 50\n")
    assert read_mesh(pyramid, "a").bounds[1].max() == pytest.approx(0.2)


def test_materials_are_put_into_one_picture(tmp_path: Path) -> None:
    picture = _picture(tmp_path / "b.png", 8)
    (tmp_path / "b.mtl").write_text(
        "newmtl red\nKd 1 0 0\nnewmtl pic\nmap_Kd b.png\nnewmtl unused\nKd 0 1 0\n"
    )
    (tmp_path / "b.obj").write_text(
        "mtllib b.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0.5 0.5\nvt 3.0 0\nvt 4 0\nvt 3 1\n"
        "usemtl red\nf 1/1 2/1 3/1\nusemtl pic\nf 1/2 2/3 4/4\n"
    )
    mesh = read_mesh(tmp_path / "b.obj", "b")
    weights = np.array([[0.4, 0.3, 0.3]])
    assert surface_colors(mesh, np.array([0]), weights)[0].tolist() == pytest.approx(
        [1, 0, 0], abs=1e-6
    )
    plain = Mesh(
        "p",
        mesh.vertices,
        mesh.faces[1:],
        np.array([[[0, 0], [1, 0], [0, 1]]], dtype=np.float32),
        picture,
        None,
        mesh.corner_normals[1:],
    )
    assert surface_colors(mesh, np.array([1]), weights) == pytest.approx(
        surface_colors(plain, np.array([0]), weights), abs=0.01
    )


def test_plain_obj_has_one_color(tmp_path: Path) -> None:
    (tmp_path / "c.mtl").write_text("newmtl m\nKd 0.2 0.4 0.6\n")
    (tmp_path / "c.obj").write_text("mtllib c.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\n")
    mesh = read_mesh(tmp_path / "c.obj", "c")
    assert mesh.corner_uv is None
    assert mesh.texture.tolist() == [[[51, 102, 153]]]
    assert mesh.corner_normals.tolist() == [[[0, 0, 1]] * 3]


def test_glb_shows_the_colors_of_the_same_obj(pyramid: Path, tmp_path: Path) -> None:
    mesh = read_mesh(pyramid, "a")
    assert mesh.corner_uv is not None
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(mesh.texture))
    body = trimesh.Trimesh(
        mesh.vertices[mesh.faces].reshape(-1, 3),
        np.arange(mesh.faces.size).reshape(-1, 3),
        visual=trimesh.visual.TextureVisuals(uv=mesh.corner_uv.reshape(-1, 2), material=material),
        process=False,
    )
    scene = trimesh.Scene()
    scene.add_geometry(body, transform=trimesh.transformations.translation_matrix([0, 0, 0.3]))
    scene.export(tmp_path / "a.glb")
    other = read_mesh(tmp_path / "a.glb", "a")
    face, weights = sample_surface(mesh, 200)
    shifted = surface_points(mesh, face, weights) + np.array([0, 0, 0.3])
    # transforms of the scene are applied
    assert surface_points(other, face, weights) == pytest.approx(shifted, abs=1e-6)
    assert surface_colors(other, face, weights) == pytest.approx(
        surface_colors(mesh, face, weights), abs=1e-5
    )


def test_ply_keeps_vertex_colors(tmp_path: Path) -> None:
    body = trimesh.creation.icosphere(subdivisions=1, radius=0.05)
    body.visual.vertex_colors = np.concatenate(
        [np.random.default_rng(5).integers(0, 256, (42, 3)), np.full((42, 1), 255)], 1
    )
    body.export(tmp_path / "ball.ply")
    mesh = read_mesh(tmp_path / "ball.ply", "ball")
    assert mesh.corner_colors is not None
    assert mesh.corner_uv is None
    assert mesh.corner_colors == pytest.approx(
        body.visual.vertex_colors[:, :3][mesh.faces] / 255, abs=1e-6
    )
    assert surface_colors(mesh, np.array([7]), np.array([[1.0, 0, 0]]))[0] == pytest.approx(
        mesh.corner_colors[7, 0]
    )


def test_ply_of_bop_reads_its_texture(tmp_path: Path) -> None:
    picture = _picture(tmp_path / "obj_000001.png")
    (tmp_path / "obj_000001.ply").write_text(
        "ply\nformat ascii 1.0\ncomment TextureFile obj_000001.png\nelement vertex 3\nproperty "
        "float x\nproperty float y\n"
        "property float z\nproperty float nx\nproperty float ny\nproperty float nz\nproperty "
        "float texture_u\n"
        "property float texture_v\nelement face 1\nproperty list uchar int "
        "vertex_indices\nend_header\n"
        "0 0 0 0 0.6 0.8 0 0\n10 0 0 0 0.6 0.8 1 0\n0 10 0 0 0.6 0.8 0 1\n3 0 1 2\n"
    )
    mesh = read_mesh(tmp_path / "obj_000001.ply", "obj_000001", scale=0.001)
    assert mesh.bounds[1].tolist() == pytest.approx([0.01, 0.01, 0])
    assert mesh.corner_uv is not None
    assert mesh.corner_uv[0].tolist() == [[0, 0], [1, 0], [0, 1]]
    assert np.array_equal(mesh.texture, picture)
    # the file's, not the triangle's
    assert mesh.corner_normals[0, 0] == pytest.approx([0, 0.6, 0.8], abs=1e-6)
    (tmp_path / "obj_000001.png").unlink()
    _rejects(tmp_path / "obj_000001.ply", "obj_000001.png", "missing texture")


_PLAIN_PLY = """ply
format ascii 1.0
{comments}element vertex 3
property float x
property float y
property float z
{properties}element face 1
property list uchar int vertex_indices
end_header
0 0 0 {first}
1 0 0 {second}
0 1 0 {third}
3 0 1 2
"""
_COLORS = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
_MAPPED = "property float s\nproperty float t\n"


def _write_ply(path: Path, comments: str, properties: str, *values: str) -> Path:
    first, second, third = values
    text = _PLAIN_PLY.format(
        comments=comments, properties=properties, first=first, second=second, third=third
    )
    path.write_text(text)
    return path


@pytest.mark.parametrize("named", ["red", "diffuse_red", "r"])
def test_ply_has_its_colors_where_coordinates_have_no_picture(tmp_path: Path, named: str) -> None:
    colors = _COLORS
    if named == "diffuse_red":
        colors = colors.replace("uchar ", "uchar diffuse_")
    elif named == "r":
        colors = "".join(f"property uchar {name}\n" for name in "rgb")
    values = ["255 0 0 0 0", "0 255 0 1 0", "0 0 255 0 1"]
    path = _write_ply(tmp_path / "a.ply", "", colors + _MAPPED, *values)
    mesh = read_mesh(path, "a")
    assert mesh.corner_uv is None
    assert mesh.corner_colors is not None
    assert np.array_equal(mesh.corner_colors[0], np.eye(3))


def test_ply_with_picture_and_colors_has_its_picture(tmp_path: Path) -> None:
    picture = _picture(tmp_path / "p.png")
    values = ["9 9 9 0 0", "9 9 9 1 0", "9 9 9 0 1"]
    comments = "comment made by hand\n" * 400 + "comment TextureFile p.png\n"  # a long header
    mesh = read_mesh(_write_ply(tmp_path / "a.ply", comments, _COLORS + _MAPPED, *values), "a")
    assert np.array_equal(mesh.texture, picture)
    assert mesh.corner_colors is None
    (tmp_path / "p.png").unlink()
    _rejects(tmp_path / "a.ply", "p.png", "missing texture", "a.ply")


def test_ply_whose_picture_has_no_place_is_refused(tmp_path: Path) -> None:
    _picture(tmp_path / "p.png")
    _picture(tmp_path / "q.png")
    one, two = (f"comment TextureFile {name}.png\n" for name in "pq")
    path = _write_ply(tmp_path / "a.ply", one, "", "", "", "")
    _rejects(path, "a.ply", "names a texture (p.png), but no texture coordinates")
    path = _write_ply(tmp_path / "b.ply", one + two, _MAPPED, "0 0", "1 0", "0 1")
    _rejects(path, "b.ply", "names 2 textures (p.png, q.png)")
    gone = "comment TextureFile gone.png\n"
    path = _write_ply(tmp_path / "d.ply", gone, _COLORS, "9 9 9", "9 9 9", "9 9 9")
    _rejects(path, "gone.png", "missing texture", "d.ply")
    path = _write_ply(tmp_path / "c.ply", one + one, _MAPPED, "0 0", "1 0", "0 1")
    assert read_mesh(path, "c").corner_uv is not None


def _rejects(path: Path, *words: str) -> None:
    with pytest.raises(UserError) as caught:
        read_mesh(path, "x")
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message


def test_missing_and_broken_files_are_named(pyramid: Path) -> None:
    folder = pyramid.parent
    _rejects(folder / "none.obj", "none.obj", "no such")
    (folder / "x.stl").write_text("")
    _rejects(folder / "x.stl", "x.stl", ".obj")
    (folder / "pic ture.png").write_bytes((folder / "pic ture.png").read_bytes()[:60])
    _rejects(pyramid, "pic ture.png", "not a readable picture")
    (folder / "pic ture.png").unlink()
    _rejects(pyramid, "pic ture.png", "missing texture", "a.mtl")
    (folder / "a.mtl").unlink()
    _rejects(pyramid, "a.mtl", "missing material file", "a.obj")


def test_corrupt_meshes_are_named(tmp_path: Path) -> None:
    cut = tmp_path / "cut.obj"
    cut.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n")
    _rejects(cut, "cut.obj", "vertex that is not there")
    cut.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -4\n")
    _rejects(cut, "cut.obj", "vertex that is not there")
    cut.write_text("v 0 0 0\nv 1 0 0\nv 0 1\nf 1 2 3\n")
    _rejects(cut, "cut.obj", "not a readable mesh")
    cut.write_text("v 0 0 0\nv 1 0 0\nv 0 1 nan\nf 1 2 3\n")
    _rejects(cut, "cut.obj", "not finite")
    cut.write_text("v 0 0 0\n")
    _rejects(cut, "cut.obj", "no triangles")
    cut.write_bytes(b"")
    _rejects(cut, "cut.obj", "no triangles")
    for suffix in (".ply", ".glb"):
        whole = tmp_path / f"whole{suffix}"
        trimesh.creation.icosphere().export(whole)
        broken = tmp_path / f"broken{suffix}"
        broken.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
        _rejects(broken, broken.name)
        broken.write_bytes(b"")
        _rejects(broken, broken.name)


def test_obj_of_other_exporters_keeps_its_texture(pyramid: Path) -> None:
    """A byte-order mark, tabs, lower case, and lines that go on."""
    mesh = read_mesh(pyramid, "a")
    text = OBJ.replace("v 0.1 0 0\n", "\tv\t0.1 0 \\\n0\n")
    pyramid.write_bytes(b"\xef\xbb\xbf" + text.encode())
    (pyramid.parent / "a.mtl").write_bytes(b"\xef\xbb\xbfnewmtl m\n  map_kd\tpic ture.png\n")
    other = read_mesh(pyramid, "a")
    np.testing.assert_array_equal(other.vertices, mesh.vertices)
    np.testing.assert_array_equal(other.texture, mesh.texture)


def test_a_texture_that_would_be_lost_is_named(pyramid: Path, tmp_path: Path) -> None:
    bare = OBJ.replace("f 3/1/2 4/2/2 5/5/2", "f 3//2 4//2 5//2")
    pyramid.write_text(bare)
    _rejects(pyramid, "a.obj", "without texture coordinates")
    pyramid.write_text("mtllib a.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    _rejects(pyramid, "a.obj", "without texture coordinates")
    # of a material in one color they need none, and the others keep theirs
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd pic ture.png\nnewmtl plain\nKd 1 0 0\n")
    face = "f 3//2 4//2 5//2\n"
    pyramid.write_text(bare.replace(face, f"usemtl plain\n{face}usemtl m\n"))
    colors = surface_colors(read_mesh(pyramid, "a"), np.array([0, 4]), np.full((2, 3), 1 / 3))
    np.testing.assert_allclose(colors[1], [1, 0, 0], atol=0.01)
    assert colors[0].std() > 0.001
    pyramid.write_text(OBJ.replace("usemtl m", "usemtl other"))
    _rejects(pyramid, "a.obj", "material 'other' is in no material file")
    pyramid.write_text(OBJ.replace("mtllib a.mtl\n", ""))
    _rejects(pyramid, "a.obj", "material 'm' is in no material file")
    pyramid.write_text(OBJ.replace("f -5/2/-1", "f -5/-9/-1"))
    _rejects(pyramid, "a.obj", "a face names vt -9")


def test_vertex_colors_little_above_one_are_no_numbers_of_8_bits(tmp_path: Path) -> None:
    lines = [f"v {x} {y} 0 1.002 0.5 0" for x, y in ((0, 0), (1, 0), (0, 1))]
    (tmp_path / "a.obj").write_text("\n".join([*lines, "f 1 2 3"]))
    colors = read_mesh(tmp_path / "a.obj", "a").corner_colors
    np.testing.assert_allclose(colors, np.tile([1, 0.5, 0], (1, 3, 1)), atol=1e-6)


def test_vertex_colors_of_255_are_scaled(tmp_path: Path) -> None:
    lines = [f"v {x} {y} {z} 255 0 51" for x, y, z in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))]
    (tmp_path / "a.obj").write_text("\n".join([*lines, "f 1 2 3", "f 1 2 4", "f 2 3 4"]))
    mesh = read_mesh(tmp_path / "a.obj", "a")
    assert mesh.corner_colors is not None
    np.testing.assert_allclose(mesh.corner_colors[0, 0], [1, 0, 0.2], atol=1e-6)


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "KHR_texture_transform"])
def test_extensions_that_would_be_left_out_are_named(tmp_path: Path, name: str) -> None:
    content = json.dumps({"extensionsRequired": [name], "extensionsUsed": [name]}).encode()
    content += b" " * (-len(content) % 4)
    chunk = struct.pack("<II", len(content), 0x4E4F534A) + content
    (tmp_path / "a.glb").write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunk)) + chunk)
    _rejects(tmp_path / "a.glb", "a.glb", name, "export it without")


def test_a_gray_may_be_one_number_and_coordinates_must_be_numbers(tmp_path: Path) -> None:
    (tmp_path / "m.mtl").write_text("newmtl a\nKd .5\n")
    corners = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nvt 0 0\nvt 1 0\nvt 0 {last}\n"
    faces = "usemtl a\nf 1/1 2/2 3/3\nf 1/1 3/3 4/2\nf 1/1 4/2 2/3\nf 2/1 4/2 3/3\n"
    for last, name in (("1", "good"), ("nan", "bad")):
        text = "mtllib m.mtl\n" + corners.format(last=last) + faces
        (tmp_path / f"{name}.obj").write_text(text)
    mesh = read_mesh(tmp_path / "good.obj", "good")
    np.testing.assert_allclose(mesh.texture.reshape(-1, 3)[0] / 255, 0.5, atol=0.01)
    with pytest.raises(UserError, match=r"bad\.obj: texture coordinates or colors that are not"):
        read_mesh(tmp_path / "bad.obj", "bad")


def _export_glb(path: Path, picture: np.ndarray, uv: bool) -> None:
    """Write a tetrahedron with a picture, with texture coordinates or without."""
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(picture))
    visual = trimesh.visual.TextureVisuals(uv=corners[:, :2] * 10, material=material)
    trimesh.Trimesh(corners, faces, visual=visual, process=False).export(path)
    if not uv:  # under another name, a reader does not find them
        path.write_bytes(path.read_bytes().replace(b"TEXCOORD_0", b"TEXCOORX_0"))


def test_a_picture_of_16_bits_is_as_bright_as_one_of_8(tmp_path: Path) -> None:
    gray = np.linspace(20, 160, 64).astype(np.uint8).reshape(8, 8)
    _export_glb(tmp_path / "eight.glb", gray, uv=True)
    _export_glb(tmp_path / "sixteen.glb", gray.astype(np.uint16) * 257, uv=True)
    eight, sixteen = (read_mesh(tmp_path / f"{name}.glb", "a") for name in ("eight", "sixteen"))
    np.testing.assert_array_equal(sixteen.texture, eight.texture)


def test_a_picture_without_texture_coordinates_is_refused(tmp_path: Path) -> None:
    gray = np.linspace(20, 160, 64).astype(np.uint8).reshape(8, 8)
    _export_glb(tmp_path / "a.glb", gray, uv=False)
    with pytest.raises(UserError, match=r"a\.glb: faces without texture coordinates"):
        read_mesh(tmp_path / "a.glb", "a")
    _export_glb(tmp_path / "plain.glb", np.full((8, 8), 90, dtype=np.uint8), uv=False)
    assert read_mesh(tmp_path / "plain.glb", "plain").texture.mean() == pytest.approx(90, abs=1)


def test_a_comment_that_ends_with_a_backslash_is_one_line(pyramid: Path) -> None:
    """As of a folder of Windows; a line that goes on is one, too."""
    plain = read_mesh(pyramid, "a")
    text = "# made of C:\\cad\\\n" + OBJ.replace("v 0 0.1 0\n", "v 0 \\\n0.1 0\n")
    pyramid.write_text(text)
    after = read_mesh(pyramid, "a")
    np.testing.assert_array_equal(after.vertices, plain.vertices)
    np.testing.assert_array_equal(after.texture, plain.texture)


def test_a_plys_texture_may_have_any_name(tmp_path: Path) -> None:
    picture = _picture(tmp_path / "Tür.png")
    header = "ply\nformat ascii 1.0\ncomment TextureFile Tür.png\nelement vertex 3\n"
    header += "property float x\nproperty float y\nproperty float z\n"
    header += "property float texture_u\nproperty float texture_v\nelement face 1\n"
    header += "property list uchar int vertex_indices\nend_header\n"
    rows = "0 0 0 0 0\n0.1 0 0 1 0\n0 0.1 0 0 1\n3 0 1 2\n"
    (tmp_path / "a.ply").write_text(header + rows, encoding="utf-8")
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.ply", "a").texture, picture)


def _export_balls(path: Path, pictures: list[Image.Image], places: list[np.ndarray]) -> None:
    """Write a GLB of balls with normals, each with a picture and at a place (4, 4)."""
    scene = trimesh.Scene()
    materials = {
        id(picture): trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
        for picture in pictures
    }
    for picture, place in zip(pictures, places, strict=True):
        ball = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
        ball.vertex_normals = ball.vertices / 0.05
        uv = np.random.default_rng(0).random((len(ball.vertices), 2))
        ball.visual = trimesh.visual.TextureVisuals(uv=uv, material=materials[id(picture)])
        scene.add_geometry(ball, transform=place)
    path.write_bytes(scene.export(file_type="glb", include_normals=True))


def test_parts_of_a_glb_with_one_picture_have_one_texture(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    one, alike = Image.fromarray(image), Image.fromarray(image)
    places = [trimesh.transformations.translation_matrix([0.2 * i, 0, 0]) for i in range(5)]
    _export_balls(tmp_path / "a.glb", [one, one, alike, one, alike], places)
    mesh = read_mesh(tmp_path / "a.glb", "a")
    np.testing.assert_array_equal(mesh.texture, image)
    # beside another picture it is stacked once
    other = Image.fromarray(image[::-1].copy())
    _export_balls(tmp_path / "b.glb", [one, one, alike, one, other], places)
    two = read_mesh(tmp_path / "b.glb", "b")
    assert max(two.texture.shape) <= 2 * (32 + 16)
    faces = np.flatnonzero(two.vertices[two.faces[:, 0], 0] < 0.7)
    weights = np.full((len(faces), 3), 1 / 3)
    np.testing.assert_allclose(
        surface_colors(two, faces, weights), surface_colors(mesh, faces, weights), atol=1e-4
    )


@pytest.mark.parametrize("scale", [(1, 1, 1), (1, 1, 0.2), (-1, 1, 0.2), (1e-3, 1e-3, 1e-3)])
def test_a_glb_keeps_the_normals_of_its_file(
    scale: tuple[float, float, float], tmp_path: Path
) -> None:
    """They move with the surface, also where it is stretched or mirrored."""
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])
    place = turn @ np.diag([*scale, 1.0])
    picture = Image.fromarray(np.full((2, 2, 3), 90, np.uint8))
    _export_balls(tmp_path / "a.glb", [picture], [place])
    mesh = read_mesh(tmp_path / "a.glb", "a")
    inverse = np.linalg.inv(place[:3, :3])
    outward = mesh.vertices @ inverse.T @ inverse
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    np.testing.assert_allclose(mesh.corner_normals, outward[mesh.faces], atol=1e-5)
    volume = measure_volume(mesh.vertices, mesh.faces)
    assert volume == pytest.approx(4 / 3 * np.pi * 0.05**3 * abs(np.prod(scale)), rel=0.1)


@pytest.mark.parametrize(
    ("material", "fails"),
    [
        ({"baseColorFactor": [0, 0, 0, 255], "emissiveFactor": [1, 0, 0]}, True),
        ({"emissiveTexture": True, "emissiveFactor": [1, 1, 1]}, True),
        ({"baseColorFactor": [9, 9, 9, 255], "emissiveFactor": [1, 0, 0]}, False),
        ({"baseColorFactor": [0, 0, 0, 255]}, False),
    ],
)
def test_a_color_that_is_emitted_alone_is_refused(
    material: dict[str, Any], fails: bool, tmp_path: Path
) -> None:
    if "emissiveTexture" in material:
        material = {**material, "emissiveTexture": Image.fromarray(np.eye(4, dtype=np.uint8))}
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.05)
    ball.visual = trimesh.visual.TextureVisuals(
        uv=ball.vertices[:, :2], material=trimesh.visual.material.PBRMaterial(**material)
    )
    ball.export(tmp_path / "a.glb")
    if fails:
        _rejects(tmp_path / "a.glb", "a.glb", "its color in what it emits", "base color")
    else:
        read_mesh(tmp_path / "a.glb", "a")
