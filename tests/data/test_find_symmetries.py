"""Symmetries that are found: of shapes that are known, and of scans."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from posefilter.figures.symmetries import describe_turn, draw_symmetries, is_in_use
from posefilter.meshes.builtin import catalog
from posefilter.meshes.find_symmetries import FOLDS, find_symmetries
from posefilter.meshes.mesh import Mesh, diameter
from posefilter.meshes.rotational_symmetries import (
    ANY,
    RotationalSymmetry,
    describe_symmetries,
    make_group,
    select,
)
from posefilter.meshes.store import MeshStore
from posefilter.meshes.symmetries import read_symmetries, rotation_about


def folds(turns: list[RotationalSymmetry], texture: bool) -> list[int]:
    return sorted(turn.fold for turn in select(turns, texture))


def distance_to(group: np.ndarray, transform: np.ndarray) -> float:
    """Return how near the nearest element is, by the largest entry."""
    return float(np.abs(group - transform).max((1, 2)).min())


def paint_gray(solid: trimesh.Trimesh) -> Mesh:
    gray = np.full((2, 2, 3), 128, np.uint8)
    normals = np.repeat(np.array(solid.face_normals)[:, None], 3, axis=1)
    vertices, faces = np.array(solid.vertices), np.array(solid.faces)
    return Mesh("solid", vertices, faces, None, gray, None, normals)


def test_a_printed_box_is_symmetric_by_shape_alone() -> None:
    mesh = catalog.build("gelatin_carton")
    turns = find_symmetries(mesh)
    assert folds(turns, texture=True) == []
    assert folds(turns, texture=False) == [2, 2, 2]
    group = make_group(select(turns, texture=False), diameter(mesh.vertices))
    assert len(group) == 4
    for axis in np.eye(3):
        half = rotation_about(axis, np.pi, mesh.bounds.mean(0))
        assert distance_to(group, half) < 0.02


def test_an_unprinted_brick_keeps_the_declared_half_turns() -> None:
    mesh = catalog.build("brick")
    group = make_group(select(find_symmetries(mesh)), diameter(mesh.vertices))
    for declared in mesh.symmetries:
        assert distance_to(group, declared) < 0.02


def test_a_printed_can_turns_by_shape_alone_and_may_be_upside_down() -> None:
    mesh = catalog.build("soup_can")
    turns = find_symmetries(mesh)
    assert folds(turns, texture=True) == []
    assert folds(turns, texture=False) == [ANY, 2]
    free = next(turn for turn in turns if turn.fold == ANY)
    assert abs(free.axis[2]) > 0.999
    assert np.abs(free.point[:2]).max() < 5e-4
    assert len(make_group(select(turns, texture=False), 0.12)) == 72


@pytest.mark.parametrize("name", ["mug", "bowl"])
def test_a_handle_and_a_foot_break_symmetry(name: str) -> None:
    turns = find_symmetries(catalog.build(name))
    expected = [ANY] if name == "bowl" else []
    assert folds(turns, texture=False) == folds(turns, texture=True) == expected


@pytest.mark.parametrize(
    ("sides", "ratio", "expected"), [(64, 1.0, [ANY]), (4, 0.9, [4]), (4, 1.0, [4])]
)
def test_the_axis_of_a_cone_as_wide_as_high_is_found(
    sides: int, ratio: float, expected: list[int]
) -> None:
    """All its moments of inertia are alike."""
    solid = trimesh.creation.cone(radius=0.05, height=0.1 * ratio, sections=sides)
    turned = solid.apply_transform(rotation_about(np.array([0.6, 0.0, 0.8]), 1.1, np.zeros(3)))
    assert folds(find_symmetries(paint_gray(turned)), texture=False) == expected


@pytest.mark.parametrize(("sides", "members"), [(5, 10), (6, 12)])
def test_a_prism_has_its_turns_and_half_turns(sides: int, members: int) -> None:
    solid = trimesh.creation.cylinder(radius=0.05, height=0.04, sections=sides)
    turns = select(find_symmetries(paint_gray(solid)), texture=False)
    assert len(make_group(turns, 0.1)) == members


CORNERS = {
    "octahedron": [*np.eye(3), *-np.eye(3)],
    "tetrahedron": [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]],
}


@pytest.mark.parametrize(("name", "members"), [("octahedron", 24), ("tetrahedron", 12)])
def test_a_solid_with_several_axes_of_third_turns_has_all_its_turns(
    name: str, members: int
) -> None:
    """All axes through its middle are principal."""
    solid = trimesh.convex.convex_hull(0.05 * np.array(CORNERS[name]))
    turned = solid.apply_transform(rotation_about(np.array([0.6, 0.0, 0.8]), 1.1, np.zeros(3)))
    turns = select(find_symmetries(paint_gray(turned)), texture=False)
    group = make_group(turns, 0.1)
    assert len(group) == members
    for transform in group:
        moved = turned.vertices @ transform[:3, :3].T + transform[:3, 3]
        assert np.abs(moved[:, None] - turned.vertices).max(-1).min(1).max() < 5e-4


def test_symmetries_move_with_the_object_and_survive_the_file(tmp_path: Path) -> None:
    """Found in another frame, they are the same turns there; read back, the same matrices."""
    bowl = catalog.build("bowl")
    pose = rotation_about(np.array([0.6, 0.0, 0.8]), 1.1, np.array([0.2, -0.1, 0.3]))
    mesh = replace(bowl, vertices=bowl.vertices @ pose[:3, :3].T + pose[:3, 3])
    turns = select(find_symmetries(mesh))
    (turn,) = turns
    assert abs(turn.axis @ pose[:3, 2]) > 0.9999
    base = pose[:3, 3]  # on the bowl's axis
    off = np.cross(turn.point - base, pose[:3, 2])
    assert np.linalg.norm(off) < 5e-4

    file = tmp_path / "symmetries.json"
    size = diameter(mesh.vertices)
    file.write_text(json.dumps(describe_symmetries(turns, size)))
    again = read_symmetries(file, "anything", 1.0, 36)
    np.testing.assert_allclose(again, make_group(turns, size), atol=1e-9)


def test_a_dent_spoils_a_symmetry() -> None:
    """A corner pulled out of a box leaves no half turn."""
    box = catalog.build("brick")
    vertices = box.vertices.copy()
    corner = np.linalg.norm(vertices - box.bounds[1], axis=1) < 1e-6
    vertices[corner] += 0.03
    assert find_symmetries(replace(box, vertices=vertices)) == []


def about(axes: list[list[float]], folds: tuple[int, ...]) -> list[RotationalSymmetry]:
    """Return turns about axes through the origin, the best first."""
    return [
        RotationalSymmetry(
            np.array(axis) / np.linalg.norm(axis), np.zeros(3), fold, 0.0, 0.0, 0.0, True, True
        )
        for axis, fold in zip(axes, folds, strict=True)
    ]


def test_a_badly_measured_axis_costs_none_of_the_others() -> None:
    """A box of square section has eight symmetries, also where a diagonal axis is 3 degrees off."""
    axes = [[1, 0, 0], [0, 0, 1], [0, 1, 0], [0.748, -0.664, 0], [-0.664, -0.748, 0]]
    group = make_group(about(axes, (2, 4, 2, 2, 2)), 0.2)
    assert len(group) == 8
    for product in (a @ b for a in group for b in group):
        assert distance_to(group, product) < 1e-9


@pytest.mark.parametrize("frame", [0.0, 0.7, 1.1])
def test_a_badly_measured_axis_that_others_imply_changes_no_turn(frame: float) -> None:
    """Two axes of a box of square section make its eight symmetries, whatever frame it is in."""
    axes = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [-0.748, 0.664, 0], [0.664, 0.748, 0.004]])
    turned = axes @ rotation_about(np.array([0.6, 0.0, 0.8]), frame, np.zeros(3))[:3, :3].T
    turns = about(turned.tolist(), (4, 2, 2, 2, 2))
    group = make_group(turns, 0.2)
    assert len(group) == 8
    for exact in make_group(turns[:2], 0.2):
        assert distance_to(group, exact) < 1e-9
    assert all(is_in_use(turn, group) for turn in turns)


def test_every_fold_that_is_tried_has_a_description() -> None:
    turns = [
        RotationalSymmetry(np.eye(3)[2], np.zeros(3), fold, 0.0, 0.0, 0.0, True, True)
        for fold in (ANY, *FOLDS)
    ]
    words = [describe_turn(turn) for turn in turns]
    assert len(set(words)) == len(turns)
    assert words[-1] == "fifth of a turn about (0.00, 0.00, 1.00)"


def test_every_turn_of_a_ball_is_in_use() -> None:
    """Its symmetries are rotations that are evenly spread, up to some 30 degrees apart."""
    rng = np.random.default_rng(0)
    axes = [axis / np.linalg.norm(axis) for axis in rng.standard_normal((40, 3))]
    turns = [
        RotationalSymmetry(axis, np.zeros(3), fold, 0.0, 0.0, 0.0, True, True)
        for axis, fold in zip(axes, [ANY, *FOLDS] * 8, strict=True)
    ]
    group = make_group(turns[::5][:2], 0.1)
    assert all(is_in_use(turn, group) for turn in turns)


def test_a_small_object_is_drawn_as_a_large_one() -> None:
    brick = catalog.build("brick")
    size = diameter(brick.vertices)
    pictures = []
    for across in (0.004, 0.2):
        mesh = replace(brick, vertices=brick.vertices * (across / size))
        turn = RotationalSymmetry(np.eye(3)[2], mesh.bounds.mean(0), 2, 0.0, 0.0, 0.05, True, True)
        pictures.append(draw_symmetries(mesh, [turn], np.eye(4)[None], "found").astype(int))
    small, large = pictures
    assert (np.abs(large - 255).sum(-1)[-200:] > 60).mean() > 0.1
    assert (np.abs(small - large).max(-1) > 10).mean() < 0.01


def test_the_picture_has_a_row_a_turn() -> None:
    mesh = catalog.build("brick")
    size = diameter(mesh.vertices)
    axis = np.array([0.0, 0.0, 1.0])
    turn = RotationalSymmetry(axis, mesh.bounds.mean(0), 2, 0.0, 0.0, 0.05, True, True)
    one = draw_symmetries(mesh, [turn], make_group([turn], size), "found")
    two = draw_symmetries(mesh, [turn, turn], make_group([turn], size), "found")
    assert two.shape[0] > one.shape[0] + 200
    tile = one[-200:]
    assert (
        tile.reshape(-1, 3).astype(int) @ [1, -1, 0] > 40
    ).mean() > 0.1  # the red brick is there


KNOWN = {  # folds by shape, and by shape and texture
    "024_bowl": ([ANY], [ANY]),
    "061_foam_brick": ([2], [2]),
    "003_cracker_box": ([2, 2, 2], []),
    "002_master_chef_can": ([ANY, 2], []),
    "005_tomato_soup_can": ([ANY, 2], []),
    "025_mug": ([], []),
    "035_power_drill": ([], []),
}


@pytest.mark.parametrize("name", KNOWN)
@pytest.mark.slow
def test_scans(name: str, real_data: Path) -> None:
    root = real_data / "ycb"
    if not (root / name).is_dir():
        pytest.skip(f"no {root / name}")
    mesh: Mesh = MeshStore(root).load(name)
    turns = find_symmetries(mesh)
    assert (folds(turns, texture=False), folds(turns, texture=True)) == KNOWN[name]
    if len(mesh.symmetries) > 1:  # what was measured before
        group = make_group(select(turns), diameter(mesh.vertices))
        for declared in mesh.symmetries:
            assert distance_to(group, declared) < 0.1
