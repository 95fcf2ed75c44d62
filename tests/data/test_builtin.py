"""The meshes that the project draws itself: closed, of the right size, textured so that no two
faces look alike.
"""

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from ycb_sizes import YCB_SIZES

from posefilter.meshes.builtin import boxes as builtin_boxes
from posefilter.meshes.builtin import catalog as builtin
from posefilter.meshes.builtin.shapes import box, disc, lathe, tube, weld
from posefilter.meshes.mesh import Mesh, surface_colors
from posefilter.meshes.store import MeshStore
from posefilter.meshes.symmetries import rotation_about

# builtin -> (the YCB object it is as large as, in which order its x, y, z are FAT's aligned axes)
TWINS = {
    "carton": ("003_cracker_box", (0, 2, 1)),
    "sugar_carton": ("004_sugar_box", (0, 2, 1)),
    "gelatin_carton": ("009_gelatin_box", (0, 2, 1)),
    "coffee_can": ("002_master_chef_can", (0, 2, 1)),
    "soup_can": ("005_tomato_soup_can", (0, 2, 1)),
    "tuna_can": ("007_tuna_fish_can", (0, 2, 1)),
    "mustard_bottle": ("006_mustard_bottle", (0, 2, 1)),
    "bleach_bottle": ("021_bleach_cleanser", (0, 2, 1)),
    "mug": ("025_mug", (0, 2, 1)),
    "bowl": ("024_bowl", (0, 2, 1)),
    "pitcher": ("019_pitcher_base", (0, 2, 1)),
    "brick": ("061_foam_brick", (0, 2, 1)),
    "banana": ("011_banana", (0, 2, 1)),
    "marker": ("040_large_marker", (1, 0, 2)),
}
NORMALS = {
    "front": (0, -1, 0),
    "back": (0, 1, 0),
    "left": (-1, 0, 0),
    "right": (1, 0, 0),
    "top": (0, 0, 1),
    "bottom": (0, 0, -1),
}
SLOT = dict.fromkeys(NORMALS, (0.0, 0.0, 1.0, 1.0))
GREY = np.full((1, 1, 3), 128, dtype=np.uint8)


def _solid(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def test_every_mesh_has_a_twin_to_be_measured_by() -> None:
    assert sorted(TWINS) == builtin.names()


@pytest.mark.parametrize("name", sorted(TWINS))
def test_sizes_are_those_of_ycb(name: str) -> None:
    twin, order = TWINS[name]
    size = np.ptp(builtin.build(name).vertices, axis=0)
    expected = np.array(YCB_SIZES[twin])[list(order)]
    if name == "brick":  # the table's y and z differ by a millimeter: either way up is right
        size, expected = np.sort(size), np.sort(expected)
    if name == "banana":
        expected = np.array(YCB_SIZES[twin])[[0, 2, 1]]
    assert size == pytest.approx(expected, abs=8e-4)


@pytest.mark.parametrize("name", builtin.names())
def test_meshes_are_closed_wound_outwards_and_light(name: str) -> None:
    mesh = builtin.build(name)
    solid = _solid(mesh)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert all(part.volume > 0 for part in solid.split())
    assert len(mesh.faces) <= 3000
    assert mesh.texture.shape == (512, 512, 3)
    assert mesh.texture.dtype == np.uint8
    assert mesh.vertices[:, 2].min() == pytest.approx(0, abs=1e-9)  # standing on z = 0
    assert np.linalg.norm(mesh.corner_normals, axis=-1) == pytest.approx(1, abs=1e-5)
    assert np.einsum("fc,fic->fi", solid.face_normals, mesh.corner_normals).min() > 0.5
    assert mesh.corner_uv is not None
    assert mesh.corner_uv.min() >= 0
    assert mesh.corner_uv.max() <= 1


def test_an_inside_out_shape_is_caught() -> None:
    soup = box((0.1, 0.1, 0.1), SLOT)
    turned = weld("x", soup._replace(corners=soup.corners[:, ::-1]), GREY)
    assert _solid(turned).volume < 0


@pytest.mark.parametrize("name", builtin.names())
def test_drawing_twice_gives_the_same(name: str) -> None:
    one, two = builtin.build(name), builtin.build(name)
    for key, value in vars(one).items():
        assert np.array_equal(value, getattr(two, key)), key


def test_shapes_have_analytic_volumes() -> None:
    cylinder = [(0.0, 0.0), (0.1, 0.0), (0.1, 0.3), (0.0, 0.3)]
    soup = lathe(cylinder, (0, 0, 1, 1), segments=200)
    assert _solid(weld("x", soup, GREY)).volume == pytest.approx(np.pi * 0.01 * 0.3, rel=1e-3)
    ellipse = [(0.0, 0.0, 0.0), (0.1, 0.05, 0.0), (0.1, 0.05, 0.3), (0.0, 0.0, 0.3)]
    soup = lathe(ellipse, (0, 0, 1, 1), segments=200)
    assert _solid(weld("x", soup, GREY)).volume == pytest.approx(np.pi * 0.005 * 0.3, rel=1e-3)
    path = np.stack([np.linspace(0, 0.5, 9), np.zeros(9), np.zeros(9)], -1)
    soup = tube(path, np.full(9, 0.02), (0, 0, 1, 1), segments=200)
    assert _solid(weld("x", soup, GREY)).volume == pytest.approx(np.pi * 0.0004 * 0.5, rel=1e-3)
    assert _solid(weld("x", box((0.1, 0.2, 0.3), SLOT), GREY)).volume == pytest.approx(0.006)


def test_lids_and_bases_are_not_mirrored() -> None:
    lid = disc([(0.1, 0.2), (0.0, 0.2)], (0.5, 0.5), 0.5)
    base = disc([(0.0, 0.0), (0.1, 0.0)], (0.5, 0.5), 0.5, up=False)
    for soup, outside in ((lid, 1.0), (base, -1.0)):
        a, b, c = (soup.corners[:, i] for i in range(3))
        normal = np.cross(b - a, c - a)[:, 2]
        u, v, w = (soup.uv[:, i] for i in range(3))
        turn = (v - u)[:, 0] * (w - u)[:, 1] - (v - u)[:, 1] * (w - u)[:, 0]
        solid = np.abs(normal) > 1e-9
        assert (np.sign(normal[solid]) == outside).all()
        assert (turn[solid] > 0).all()  # seen from outside, the picture runs the right way round


def _picture(mesh: Mesh, face: str, height: int = 24, width: int = 24) -> np.ndarray:
    """Return what one sees of a box's face, upright.  -> (height, width, 3)."""
    solid = _solid(mesh)
    normal = np.array(NORMALS[face], dtype=float)
    right, up = {"top": ((1, 0, 0), (0, 1, 0)), "bottom": ((1, 0, 0), (0, -1, 0))}.get(
        face, (tuple(np.cross([0, 0, 1], normal)), (0, 0, 1))
    )
    low, high = mesh.bounds
    center, half = (low + high) / 2, (high - low) / 2
    x = (np.arange(width) + 0.5) / width * 2 - 1
    y = 1 - (np.arange(height) + 0.5) / height * 2
    grid_x, grid_y = np.meshgrid(x, y)
    on_face = center + half * (
        normal + grid_x[..., None] * np.array(right) + grid_y[..., None] * np.array(up)
    )
    candidates = np.flatnonzero(solid.face_normals @ normal > 0.9)
    points = on_face.reshape(-1, 3) - 1e-9 * (on_face.reshape(-1, 3) - center)
    out = np.zeros((len(points), 3))
    for one in candidates:
        weights = trimesh.triangles.points_to_barycentric(
            np.repeat(solid.triangles[[one]], len(points), axis=0), points
        )
        inside = (weights > -1e-6).all(1)
        out[inside] = surface_colors(mesh, np.full(inside.sum(), one), weights[inside])
    return out.reshape(height, width, 3)


@pytest.mark.parametrize("face", sorted(NORMALS))
def test_the_carton_shows_its_print_upright_and_unmirrored(face: str) -> None:
    seen = _picture(builtin.build("carton"), face)
    printed = (
        cv2.resize(builtin_boxes.carton_faces()[face], (24, 24), interpolation=cv2.INTER_AREA) / 255
    )
    error = {
        "as it is": np.abs(seen - printed).mean(),
        "mirrored": np.abs(seen[:, ::-1] - printed).mean(),
        "upside down": np.abs(seen[::-1] - printed).mean(),
        "half a turn": np.abs(seen[::-1, ::-1] - printed).mean(),
    }
    assert min(error, key=lambda key: error[key]) == "as it is"


def test_faces_of_the_carton_differ_even_when_small() -> None:
    mesh = builtin.build("carton")
    small = {
        face: _picture(mesh, face, 40, 40).reshape(5, 8, 5, 8, 3).mean(axis=(1, 3))
        for face in NORMALS
    }  # 5 x 5 pixels
    means = {face: picture.mean(axis=(0, 1)) for face, picture in small.items()}
    for a in NORMALS:
        for b in NORMALS:
            if a < b:
                assert np.abs(means[a] - means[b]).max() > 0.1, f"{a} and {b} have the same color"
        half_turn = np.abs(small[a] - small[a][::-1, ::-1]).mean()
        assert half_turn > 0.03, f"{a} looks the same upside down"


def test_declared_symmetries_hold_for_shape_and_color() -> None:
    store = MeshStore("builtin")
    symmetric = [name for name in store.names() if len(store.load(name).symmetries) > 1]
    assert symmetric == ["bowl", "brick"]
    for name in symmetric:
        mesh = store.load(name)
        tree, colors = cKDTree(mesh.vertices), _vertex_colors(mesh)
        for turn in mesh.symmetries[1:]:
            distance, vertex = tree.query(mesh.vertices @ turn[:3, :3].T + turn[:3, 3])
            assert distance.max() < 1e-6
            assert np.abs(colors[vertex] - colors).mean() < 0.05
    brick = store.load("brick")
    # this one is none
    quarter = rotation_about(np.array([0, 0, 1.0]), np.pi / 2, brick.bounds.mean(0))
    turned = brick.vertices @ quarter[:3, :3].T + quarter[:3, 3]
    assert cKDTree(brick.vertices).query(turned)[0].max() > 1e-3


def _vertex_colors(mesh: Mesh) -> np.ndarray:
    """Return the mean color of each vertex's corners.  -> (V, 3)."""
    total, count = np.zeros((len(mesh.vertices), 3)), np.zeros((len(mesh.vertices), 1))
    for corner in range(3):
        weights = np.tile(np.eye(3)[corner], (len(mesh.faces), 1))
        np.add.at(
            total, mesh.faces[:, corner], surface_colors(mesh, np.arange(len(mesh.faces)), weights)
        )
        np.add.at(count, mesh.faces[:, corner], 1)
    return total / count
