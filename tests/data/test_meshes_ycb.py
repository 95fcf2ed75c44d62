"""Facts about YCB, on the real meshes where they are."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from ycb_sizes import YCB_SIZES

from posefilter.meshes import ycb
from posefilter.meshes.mesh import (
    diameter,
    outline_hull,
    sample_surface,
    sphere_directions,
    surface_points,
)
from posefilter.meshes.store import MeshStore

FITTING = [name for name in ycb.CLASSES if name not in ycb.WITHOUT_GEOMETRY]
SYMMETRIC = [name for name in ycb.CLASSES if ycb.symmetries(name) is not None]


@pytest.fixture(scope="module")
def store(real_data: Path) -> MeshStore:
    if not (real_data / "ycb").is_dir():
        pytest.skip(f"no YCB meshes at {real_data / 'ycb'}")
    return MeshStore(real_data / "ycb")


@pytest.fixture(scope="module")
def fat_settings(real_data: Path) -> dict[str, dict]:
    file = real_data / "fat" / "nvdu_ycb_original.json"
    if not file.is_file():
        pytest.skip(f"no {file}")
    return {
        entry["class"].removesuffix("_16k"): entry
        for entry in json.loads(file.read_text())["exported_objects"]
    }


def test_ids_count_from_one() -> None:
    assert len(ycb.CLASSES) == 21
    assert ycb.ycbvideo_index("002_master_chef_can") == 1
    with pytest.raises(KeyError):
        ycb.ycbvideo_from_original("036_wood_block")


def test_order_is_that_of_ycb_video(real_data: Path) -> None:
    assert tuple((real_data / "ycbv" / "classes.txt").read_text().split()) == ycb.CLASSES


def test_ids_and_sizes_are_those_of_fat(fat_settings: dict[str, dict]) -> None:
    assert list(fat_settings) == list(ycb.CLASSES)
    for name, entry in fat_settings.items():
        assert 12 * ycb.ycbvideo_index(name) == entry["segmentation_class_id"]
        assert np.array(YCB_SIZES[name]) * 100 == pytest.approx(
            np.array(entry["cuboid_dimensions"]), abs=2e-3
        )


@pytest.mark.parametrize("name", FITTING)
def test_meshes_fill_the_cuboids_of_fat(
    store: MeshStore, fat_settings: dict[str, dict], name: str
) -> None:
    vertices = store.load(name).vertices
    aligned = np.c_[vertices, np.ones(len(vertices))] @ np.array(
        fat_settings[name]["fixed_model_transform"]
    )
    low, high = aligned[:, :3].min(0) / 100, aligned[:, :3].max(0) / 100
    assert high - low == pytest.approx(np.array(YCB_SIZES[name]), abs=1e-4)
    assert (high + low) / 2 == pytest.approx(np.zeros(3), abs=1e-4)


@pytest.mark.parametrize("name", FITTING)
def test_meshes_lie_on_the_points_of_ycb_video(
    store: MeshStore, real_data: Path, name: str
) -> None:
    points = np.loadtxt(real_data / "ycbv" / "models" / name / "points.xyz")
    mesh = store.load(name)
    surface = surface_points(mesh, *sample_surface(mesh, 40000))
    there = ycb.ycbvideo_from_original(name)
    residual = cKDTree(surface @ there[:3, :3].T + there[:3, 3]).query(points)[0].mean()
    assert residual < 1e-3
    assert cKDTree(surface).query(points)[0].mean() > 3e-3  # without the translation they do not


@pytest.mark.parametrize("name", SYMMETRIC)
def test_declared_symmetries_map_a_mesh_onto_itself(store: MeshStore, name: str) -> None:
    mesh = store.load(name)
    assert len(mesh.symmetries) > 1
    tree = cKDTree(surface_points(mesh, *sample_surface(mesh, 20000)))
    points = surface_points(mesh, *sample_surface(mesh, 3000, seed=1))
    floor = tree.query(points)[0].mean()
    for turn in mesh.symmetries[1::7]:
        assert tree.query(points @ turn[:3, :3].T + turn[:3, 3])[0].mean() < floor + 4e-4
    wrong = mesh.symmetries[1].copy()
    wrong[:3, 3] += 0.005
    assert tree.query(points @ wrong[:3, :3].T + wrong[:3, 3])[0].mean() > floor + 4e-4


@pytest.mark.parametrize("name", ["003_cracker_box", "024_bowl", "035_power_drill"])
def test_real_meshes_are_read_well(store: MeshStore, name: str) -> None:
    mesh = store.load(name)
    assert mesh.faces.shape == (16384, 3)
    assert mesh.texture.shape == (1024, 1024, 3)
    assert np.linalg.norm(mesh.corner_normals, axis=-1) == pytest.approx(1, abs=1e-3)
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    facing = np.einsum("fc,fic->fi", np.cross(b - a, c - a), mesh.corner_normals)
    assert (facing > 0).mean() > 0.98  # the file's normals point where the winding says
    directions = sphere_directions(1000).T
    reach = [
        (points @ directions).max(axis=0) for points in (mesh.vertices, outline_hull(mesh.vertices))
    ]
    assert (reach[0] - reach[1]).max() < 1e-3
    box = np.linalg.norm(np.ptp(mesh.vertices, axis=0))
    assert 0.6 * box < diameter(mesh.vertices) <= box


def test_results_have_numbers_that_differ() -> None:
    names = ["mine", "003_cracker_box", "obj_000012", "other", "obj_000001"]
    assert ycb.number_objects(names) == {
        "mine": 3, "003_cracker_box": 2, "obj_000012": 12, "other": 4, "obj_000001": 1,
    }  # fmt: skip
    taken = number_objects_of("003_cracker_box", "obj_000002", "obj_000001")
    assert taken == [2, 3, 1]


def number_objects_of(*names: str) -> list[int]:
    return [ycb.number_objects(names)[name] for name in names]
