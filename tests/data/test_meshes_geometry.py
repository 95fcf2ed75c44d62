"""The pure functions on meshes, against analytic values and naive loops."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.distance import pdist

from posefilter.meshes.builtin import catalog as builtin
from posefilter.meshes.mesh import (
    Mesh,
    creased_normals,
    diameter,
    hull_vertices,
    object_model,
    outline_hull,
    sample_surface,
    surface_colors,
    surface_points,
)

SIZE = np.array([0.2, 0.3, 0.5])


def _mesh(
    vertices: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray | None = None,
    texture: np.ndarray | None = None,
) -> Mesh:
    texture = np.full((1, 1, 3), 128, dtype=np.uint8) if texture is None else texture
    return Mesh("test", vertices, faces, uv, texture, None, creased_normals(vertices, faces))


@pytest.fixture
def cuboid() -> Mesh:
    body = trimesh.creation.box(SIZE)
    return _mesh(
        np.asarray(body.vertices) + np.array([1.0, 2.0, 3.0]),
        np.asarray(body.faces, dtype=np.int64),
    )


def test_object_model_of_a_cuboid_is_analytic(cuboid: Mesh) -> None:
    model = object_model(cuboid, count=500)
    assert model.center.tolist() == pytest.approx([1.0, 2.0, 3.0])
    assert model.radius == pytest.approx(np.linalg.norm(SIZE) / 2)
    assert model.diameter == pytest.approx(np.linalg.norm(SIZE))
    assert model.hull.shape == (8, 3)
    assert model.points.shape == (500, 3)
    assert model.points.dtype == torch.float32
    assert torch.equal(model.symmetries, torch.eye(4)[None])
    reach = (
        ((model.points - model.center).abs() * 2 / torch.tensor(SIZE, dtype=torch.float32))
        .max(dim=1)
        .values
    )
    # every point lies on the surface, none inside
    assert torch.allclose(reach, torch.ones(500), atol=1e-5)


def test_given_points_are_kept(cuboid: Mesh) -> None:
    points = np.random.default_rng(0).normal(size=(7, 3))
    assert np.allclose(object_model(cuboid, points=points).points.numpy(), points, atol=1e-6)


def test_points_are_spread_by_area_and_seeded(cuboid: Mesh) -> None:
    face, weights = sample_surface(cuboid, 6200, seed=3)
    assert np.allclose(weights.sum(1), 1)
    assert weights.min() >= 0
    points = surface_points(cuboid, face, weights) - [1, 2, 3]
    for axis in range(3):
        area = (
            np.prod(np.delete(SIZE, axis))
            / (SIZE[0] * SIZE[1] + SIZE[1] * SIZE[2] + SIZE[0] * SIZE[2])
            / 2
        )
        for side in (-1, 1):
            share = np.isclose(points[:, axis], side * SIZE[axis] / 2).mean()
            assert share == pytest.approx(area, abs=2e-3)
    assert np.array_equal(object_model(cuboid, seed=1).points, object_model(cuboid, seed=1).points)
    assert not np.array_equal(
        object_model(cuboid, seed=1).points, object_model(cuboid, seed=2).points
    )


def test_diameter_is_the_brute_force_one() -> None:
    particles = np.random.default_rng(1).normal(size=(400, 3)) * [0.02, 0.05, 0.03]
    assert diameter(particles) == pytest.approx(pdist(particles).max(), rel=1e-12)
    flat = particles * [1, 1, 0]
    assert diameter(flat) == pytest.approx(pdist(flat).max(), rel=1e-9)


def _short(hull: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return by how much an outline falls short in random directions, by support functions [m]."""
    directions = np.random.default_rng(2).normal(size=(3000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return (vertices @ directions.T).max(0) - (hull @ directions.T).max(0)


@pytest.mark.parametrize("name", builtin.names())
def test_few_hull_vertices_draw_the_outline_within_about_a_millimeter(name: str) -> None:
    vertices = builtin.build(name).vertices
    hull = outline_hull(vertices)
    assert len(hull) <= 128
    assert _short(hull, vertices).max() < 1.25e-3
    assert _short(hull, vertices).min() > -1e-9  # nor does it reach beyond


def test_a_hull_of_too_few_vertices_is_caught() -> None:
    vertices = builtin.build("bowl").vertices
    assert _short(outline_hull(vertices, max_vertices=12), vertices).max() > 2.5e-3


def test_hull_vertices_are_the_outer_ones() -> None:
    cube = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    assert len(hull_vertices(np.concatenate([cube, cube * 0.5 + 0.25]))) == 8
    flat = cube * [1, 1, 0]
    assert np.allclose(np.ptp(outline_hull(flat), axis=0), [1, 1, 0])


def test_normals_are_crisp_on_boxes_and_smooth_on_spheres(cuboid: Mesh) -> None:
    body = trimesh.Trimesh(cuboid.vertices, cuboid.faces, process=False)
    assert np.allclose(cuboid.corner_normals, body.face_normals[:, None], atol=1e-6)
    ball = trimesh.creation.icosphere(subdivisions=3)
    # every triangle with its own vertices, as texture seams leave them
    loose = np.asarray(ball.triangles).reshape(-1, 3)
    normals = creased_normals(loose, np.arange(len(loose)).reshape(-1, 3))
    cosine = np.einsum("fic,fic->fi", normals, loose.reshape(-1, 3, 3))
    assert np.rad2deg(np.arccos(cosine.clip(-1, 1))).max() < 1.0
    assert (
        np.rad2deg(np.arccos(np.einsum("fc,fic->fi", ball.face_normals, normals).clip(-1, 1))).max()
        > 2.0
    )  # not flat


def test_normals_match_a_naive_loop() -> None:
    mesh = builtin.build("mug")
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    weighted = np.cross(b - a, c - a)
    unit = weighted / np.linalg.norm(weighted, axis=1, keepdims=True)
    for face in range(0, len(mesh.faces), 97):
        for corner in range(3):
            around = (mesh.faces == mesh.faces[face, corner]).any(1)
            total = sum(
                weighted[f]
                for f in np.flatnonzero(around)
                if unit[f] @ unit[face] >= np.cos(np.deg2rad(40))
            )
            assert mesh.corner_normals[face, corner] == pytest.approx(
                total / np.linalg.norm(total), abs=1e-5
            )


def test_colors_are_read_bilinearly_with_v_upwards() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    # red is top left
    texture = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], dtype=np.uint8)
    mesh = _mesh(vertices, faces, vertices[faces][..., :2].astype(np.float32), texture)

    def at(x: float, y: float) -> list[float]:
        face, weights = (0, [1 - x, x - y, y]) if y <= x else (1, [1 - y, x, y - x])
        return surface_colors(mesh, np.array([face]), np.array([weights]))[0].tolist()

    assert at(0.25, 0.75) == pytest.approx([1, 0, 0])
    assert at(0.75, 0.75) == pytest.approx([0, 1, 0])
    assert at(0.25, 0.25) == pytest.approx([0, 0, 1])
    assert at(0.5, 0.75) == pytest.approx([0.5, 0.5, 0])
    assert at(0.5, 0.5) == pytest.approx([0.5, 0.5, 0.5])
