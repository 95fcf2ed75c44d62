"""Declared symmetries are closed into a group, and meshes that cannot be handled are named."""

import json
from pathlib import Path

import numpy as np
import pytest

from posefilter.errors import UserError
from posefilter.meshes.files import read_mesh
from posefilter.meshes.rotational_symmetries import RotationalSymmetry, list_discrete
from posefilter.meshes.symmetries import (
    close_group,
    read_symmetries,
    rotation_about,
    symmetry_group,
)

Z, X = np.array([0.0, 0, 1]), np.array([1.0, 0, 0])
ORIGIN = np.zeros(3)


def test_a_quarter_turn_has_its_powers(tmp_path: Path) -> None:
    quarter = rotation_about(Z, np.pi / 2, np.array([0.03, 0.01, 0]))
    info = tmp_path / "symmetries.json"
    info.write_text(json.dumps({"tile": {"symmetries_discrete": [quarter.reshape(-1).tolist()]}}))
    found = read_symmetries(info, "tile", 1.0, 36)
    assert len(found) == 4
    powers = np.stack([np.linalg.matrix_power(quarter, k) for k in range(4)])
    for power in powers:
        assert np.abs(found - power).max(axis=(1, 2)).min() < 1e-9


def test_two_half_turns_have_the_third_and_a_whole_list_stays_as_it_is() -> None:
    halves = [rotation_about(axis, np.pi, ORIGIN) for axis in np.eye(3)]
    assert len(symmetry_group(halves[:2])) == 4
    rough = [np.round(one + 1e-3, 2) for one in halves]  # as files of few digits have them
    group = close_group(rough)
    assert len(group) == 4
    assert all(a is b for a, b in zip(group[1:], rough, strict=True))


def test_turns_whose_products_have_no_end_are_refused(tmp_path: Path) -> None:
    turns = [rotation_about(axis, 1.0, ORIGIN) for axis in (Z, X)]
    info = tmp_path / "symmetries.json"
    info.write_text(
        json.dumps({"a": {"symmetries_discrete": [t.reshape(-1).tolist() for t in turns]}})
    )
    with pytest.raises(UserError, match="products of its discrete symmetries have no end"):
        read_symmetries(info, "a", 1.0, 36)


@pytest.mark.parametrize("away", [0.0, 0.3, 3.0, 300.0])
def test_found_turns_do_not_depend_on_the_origin(away: float) -> None:
    """Three half turns of a box, their axes off by a degree."""
    center, off = np.array([away, away / 3, 0]), np.deg2rad(1.0)
    axes = np.eye(3) @ rotation_about(Z, off, ORIGIN)[:3, :3]
    axes[2] = rotation_about(X, off, ORIGIN)[:3, :3] @ axes[2]
    turns = [RotationalSymmetry(axis, center, 2, 0.0, 0.0, 0.0, True, True) for axis in axes]
    assert len(list_discrete(turns, 0.14)) == 3


L_SHAPE = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]


def write_prism(path: Path, away: float = 0.0) -> None:
    """Write an L-shaped prism of text, its two ends one face of six corners each."""
    corners = [(0.1 * x + away, 0.1 * y, z) for z in (0.0, 0.05) for x, y in L_SHAPE]
    sides = [(i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6) for i in range(6)]
    faces = [tuple(reversed(range(6))), tuple(range(6, 12)), *sides]
    head = ["ply", "format ascii 1.0", f"element vertex {len(corners)}"]
    head += [f"property double {axis}" for axis in "xyz"]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    rows = [" ".join(map(repr, corner)) for corner in corners]
    rows += [" ".join(map(str, (len(face), *face))) for face in faces]
    path.write_text("\n".join([*head, *rows]) + "\n")


def test_concave_faces_of_a_text_ply_cover_themselves_alone(tmp_path: Path) -> None:
    write_prism(tmp_path / "l.ply")
    mesh = read_mesh(tmp_path / "l.ply", "l")
    corners = mesh.vertices[mesh.faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    ends = 2 * 3 * 0.1**2
    assert np.linalg.norm(area, axis=1).sum() / 2 == pytest.approx(ends + 8 * 0.1 * 0.05)


def test_an_object_far_from_its_origin_is_refused(tmp_path: Path) -> None:
    write_prism(tmp_path / "far.ply", away=1e5)
    with pytest.raises(UserError, match=r"far\.ply: an object of 0\.2 m whose origin is 100,000 m"):
        read_mesh(tmp_path / "far.ply", "far")
    write_prism(tmp_path / "near.ply", away=50.0)
    assert len(read_mesh(tmp_path / "near.ply", "near").faces) == 20


def test_triangles_on_a_line_are_refused(tmp_path: Path) -> None:
    rows = [f"v {t} {t} {t}" for t in (0.0, 0.1, 0.2, 0.3)]
    (tmp_path / "line.obj").write_text("\n".join([*rows, "f 1 2 3", "f 2 3 4"]) + "\n")
    with pytest.raises(UserError, match=r"line\.obj: the triangles have no area"):
        read_mesh(tmp_path / "line.obj", "line")
