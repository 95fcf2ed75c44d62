"""Meshes written and read again, and what a look at a mesh tells."""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from posefilter.cli.onboarded_mesh import read_onboarded
from posefilter.errors import UserError
from posefilter.meshes.builtin import catalog
from posefilter.meshes.files import read_mesh
from posefilter.meshes.inspect_mesh import check_size, inspect_mesh, list_concerns
from posefilter.meshes.mesh import (
    Mesh,
    grid_faces,
    sample_surface,
    surface_colors,
    surface_points,
)
from posefilter.meshes.write import write_obj


@pytest.fixture(scope="module")
def brick() -> Mesh:
    return catalog.build("brick")


@pytest.mark.parametrize("kind", ["textured", "painted", "plain"])
def test_a_written_mesh_is_read_as_it_was(kind: str, brick: Mesh, tmp_path: Path) -> None:
    mesh = brick
    if kind != "textured":
        gray = np.full((1, 1, 3), 255, np.uint8)
        mesh = replace(mesh, corner_uv=None, texture=gray)
    if kind == "painted":
        colors = np.random.default_rng(0).random((len(mesh.faces), 3, 3)).astype(np.float32)
        mesh = replace(mesh, corner_colors=colors)
    again = read_mesh(write_obj(mesh, tmp_path / "one"), mesh.name)
    face, weights = sample_surface(mesh, 500)
    for read in (surface_points, surface_colors):
        np.testing.assert_allclose(read(again, face, weights), read(mesh, face, weights), atol=1e-5)
    np.testing.assert_allclose(again.corner_normals, mesh.corner_normals, atol=1e-6)


def test_what_a_closed_printed_box_is(brick: Mesh) -> None:
    facts = inspect_mesh(brick)
    width, depth, height = facts.size_mm
    assert facts.open_edges == 0
    assert facts.volume_cm3 == pytest.approx(width * depth * height / 1000, rel=1e-6)
    assert facts.diameter_mm == pytest.approx(np.linalg.norm(facts.size_mm))
    assert facts.colored
    assert list_concerns(facts) == []


def test_a_hole_and_a_lost_texture_are_reported(brick: Mesh) -> None:
    halved = replace(brick, faces=brick.faces[: len(brick.faces) // 2])
    plain = replace(brick, corner_uv=None, texture=brick.texture[:1, :1])
    for mesh, word in ((halved, "not closed"), (plain, "one color")):
        (concern,) = list_concerns(inspect_mesh(mesh))
        assert word in concern


@pytest.mark.parametrize("inward", [False, True])
def test_faces_without_an_area_leave_a_surface_closed(inward: bool, tmp_path: Path) -> None:
    """A ball of a grid of angles has some at its poles."""
    polar, turn = np.meshgrid(np.linspace(0, np.pi, 13), np.linspace(0, 2 * np.pi, 17)[:-1])
    x, y = 0.05 * np.sin(polar) * np.cos(turn), 0.05 * np.sin(polar) * np.sin(turn)
    points = np.stack([x, y, 0.05 * np.cos(polar)], axis=-1).reshape(-1, 3)
    faces = grid_faces(17, 13) % len(points)
    faces = faces[:, ::-1] if inward else faces
    lines = [f"v {a:.7f} {b:.7f} {c:.7f}" for a, b, c in points.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (1 + faces).tolist()]
    (tmp_path / "ball.obj").write_text("\n".join(lines))
    ball = read_mesh(tmp_path / "ball.obj", "ball")
    facts = inspect_mesh(ball)
    assert facts.open_edges == 0
    assert facts.volume_cm3 == pytest.approx(4 / 3 * np.pi * 125, rel=0.1)
    assert not any("not closed" in concern for concern in list_concerns(facts))


@pytest.mark.parametrize(
    ("scale", "helps"), [(1e5, False), (30, True), (0.05, True), (1e-3, False)]
)
def test_a_unit_of_meters_is_advised_where_it_is_taken(
    scale: float, helps: bool, brick: Mesh, tmp_path: Path
) -> None:
    large = replace(brick, vertices=brick.vertices * scale)
    with pytest.raises(UserError) as refused:
        check_size(inspect_mesh(large), "drill.obj")
    assert str(refused.value).endswith("give mesh_scale=1") == helps
    file = str(write_obj(large, tmp_path / "drill"))
    cfg = OmegaConf.create({"mesh": file, "name": None, "mesh_scale": 1})
    with nullcontext() if helps else pytest.raises(UserError, match=r"mesh_scale=1: .* mm across"):
        read_onboarded(cfg)


@pytest.mark.parametrize(("scale", "advice"), [(1000, "0.001"), (100, "0.01")])
def test_another_unit_is_named(scale: float, advice: str, brick: Mesh) -> None:
    facts = inspect_mesh(replace(brick, vertices=brick.vertices * scale))
    with pytest.raises(UserError, match=f"mesh_scale={advice}"):
        check_size(facts, "drill.obj")
    check_size(inspect_mesh(brick), "drill.obj")


def test_two_materials_of_one_color_each_are_more_than_one_color(brick: Mesh) -> None:
    """Their coordinates are points, which have no extent in the texture."""
    uv = np.full((len(brick.faces), 3, 2), 0.25, dtype=np.float32)
    uv[::2, :, 1] = 0.75
    texture = np.array([[[200, 0, 0]], [[0, 0, 200]]], dtype=np.uint8)
    two = replace(brick, corner_uv=uv, texture=texture)
    assert inspect_mesh(two).texture_px_per_mm == 0
    assert inspect_mesh(two).colored
    assert not inspect_mesh(replace(two, corner_uv=uv[:1].repeat(len(uv), axis=0))).colored
