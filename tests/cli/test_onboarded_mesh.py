"""The object that is onboarded: its name, its unit, and symmetries that are given."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from omegaconf import DictConfig, OmegaConf

from posefilter.cli import onboarded_mesh
from posefilter.cli.onboarded_mesh import (
    find_and_draw,
    find_declared,
    name_of,
    read_onboarded,
    write_meshes,
)
from posefilter.errors import UserError
from posefilter.meshes.builtin import catalog
from posefilter.meshes.mesh import Mesh, diameter
from posefilter.meshes.rotational_symmetries import RotationalSymmetry
from posefilter.meshes.store import MeshStore
from posefilter.meshes.write import write_obj


def settings(mesh: Path | str, **more: object) -> DictConfig:
    given = {
        "mesh": str(mesh), "name": None, "mesh_scale": None, "distractor_meshes": "builtin",
        "distractor_scale": None, "seed": 0,
    }  # fmt: skip
    return OmegaConf.create({**given, **more})


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("drill.obj", "drill"),
        ("my drill (2).ply", "my_drill_2"),
        ("ycb/035_power_drill/google_16k/textured.obj", "035_power_drill"),
        ("robot/meshes/gripper/visual/model.glb", "gripper"),
    ],
)
def test_an_object_is_named_by_its_file(path: str, name: str) -> None:
    assert name_of(Path(path)) == name


def test_a_mesh_in_millimeters_is_refused_until_its_unit_is_given(tmp_path: Path) -> None:
    brick = catalog.build("brick")
    file = write_obj(replace(brick, vertices=1000 * brick.vertices), tmp_path / "brick")
    with pytest.raises(UserError, match=r"textured\.obj: 107 m across; is it mesh_scale=0\.001"):
        read_onboarded(settings(file))
    mesh = read_onboarded(settings(file, mesh_scale=0.001))
    assert mesh.name == "brick"
    np.testing.assert_allclose(mesh.bounds, brick.bounds, atol=1e-6)
    with pytest.raises(UserError, match=r"mesh=brik: no such file, and no builtin mesh \(banana"):
        read_onboarded(settings("brik"))
    with pytest.raises(UserError, match=r"is a folder; name an \.obj, \.ply or \.glb file in it"):
        read_onboarded(settings(tmp_path))
    with pytest.raises(UserError, match=r"name=\.\./up: letters"):
        read_onboarded(settings("brick", name="../up"))


def test_given_symmetries_beat_those_that_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(onboarded_mesh, "find_symmetries", lambda mesh: [])
    file = tmp_path / "given.json"
    half = [-1, 0, 0, 10.0, 0, -1, 0, 20.0, 0, 0, 1, 0, 0, 0, 0, 1]  # about z, in millimeters
    file.write_text(json.dumps({"symmetries_discrete": [half]}))
    mesh = catalog.build("brick")
    cfg = settings("brick", distractor_meshes=tmp_path / "few")
    write_obj(catalog.build("bowl"), tmp_path / "few" / "bowl")
    write_meshes(mesh, cfg, tmp_path / "meshes")
    store = tmp_path / "meshes"
    assert MeshStore(store).names() == ["bowl", "brick"]

    assert find_and_draw(mesh, str(file), 0.001, tmp_path) == f"2 symmetries of {file}"
    read = MeshStore(store).load("brick").symmetries
    np.testing.assert_allclose(
        read[1], np.reshape([*half[:3], 0.01, *half[4:7], 0.02, *half[8:]], (4, 4))
    )
    find_and_draw(mesh, "none", None, tmp_path)
    assert len(MeshStore(store).load("brick").symmetries) == 1
    file.write_text(json.dumps({"another": {"symmetries_discrete": [half]}}))
    with pytest.raises(UserError, match=r"given\.json: declares none of brick"):
        find_and_draw(mesh, str(file), 0.001, tmp_path)
    with pytest.raises(UserError, match=r"symmetries=nowhere: no such file; or choose auto"):
        find_and_draw(mesh, "nowhere", None, tmp_path)


def test_a_turn_that_fits_no_group_is_not_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Turns by a half, a third and a fifth about one axis make turns that are too small."""
    turns = [
        RotationalSymmetry(np.eye(3)[2], np.zeros(3), fold, 0.0, 0.0, 0.0, True, True)
        for fold in (2, 3, 5)
    ]
    monkeypatch.setattr(onboarded_mesh, "find_symmetries", lambda mesh: turns)
    found = find_and_draw(catalog.build("brick"), "geometry", None, tmp_path)
    z = "about (0.00, 0.00, 1.00)"
    assert found == f"half turn {z}, third of a turn {z}"


def test_a_mesh_too_small_for_a_hull_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "dot.obj"
    file.write_text("v 0 0 0\nv 1e-9 0 0\nv 0 1e-9 0\nf 1 2 3\n")
    with pytest.raises(UserError, match=r"has no convex hull; 1e-09 m across"):
        read_onboarded(settings(file))


def test_builtin_clutter_like_the_object_is_left_out(tmp_path: Path) -> None:
    """A brick by any name and a little smaller; of another color or size it stays."""
    brick = catalog.build("brick")

    def left_out(mesh: Mesh, **more: object) -> list[str]:
        facts, like = write_meshes(mesh, settings("own", **more), tmp_path / "meshes")
        assert facts.faces == len(mesh.faces)
        assert not set(like) & set(MeshStore(tmp_path / "meshes").names())
        return like

    own = replace(brick, name="own", vertices=0.95 * brick.vertices)
    assert left_out(own) == ["brick"]
    blue = replace(own, texture=np.ascontiguousarray(own.texture[..., ::-1]))
    assert left_out(blue) == []
    assert left_out(replace(own, vertices=1.4 * own.vertices)) == []
    # what is given stays: it stands beside the object
    write_obj(brick, tmp_path / "given" / "brick")
    assert left_out(own, distractor_meshes=tmp_path / "given") == []


def test_a_unit_that_makes_an_object_too_small_is_named(tmp_path: Path) -> None:
    file = write_obj(catalog.build("brick"), tmp_path / "brick")
    with pytest.raises(UserError, match=r"mesh_scale=0\.001: .* would be 0\.107 mm across"):
        read_onboarded(settings(file, mesh_scale=0.001))
    # what is large and meant to be is let through by a unit, as the refusal without one advises
    assert diameter(read_onboarded(settings(file, mesh_scale=30)).vertices) > 3


def test_clutter_may_be_in_another_unit(tmp_path: Path) -> None:
    brick = catalog.build("brick")
    write_obj(replace(brick, vertices=1000 * brick.vertices), tmp_path / "around" / "other")
    cfg = settings("brick", distractor_meshes=tmp_path / "around")
    told = r"probably in millimeters; give distractor_scale=0\.001$"
    with pytest.raises(UserError, match=told):
        write_meshes(brick, cfg, tmp_path / "meshes")
    cfg.distractor_scale = 0.001
    write_meshes(brick, cfg, tmp_path / "meshes")
    found = MeshStore(tmp_path / "meshes").load("other")
    np.testing.assert_allclose(found.bounds, brick.bounds, atol=1e-6)


def test_symmetries_that_are_declared_beside_a_mesh_are_found(tmp_path: Path) -> None:
    mesh = tmp_path / "obj_000003.ply"
    write_obj(catalog.build("brick"), tmp_path).rename(mesh)
    assert find_declared(mesh, "obj_000003", 0.001) is None
    file = tmp_path / "models_info.json"
    half = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    file.write_text(json.dumps({"3": {"symmetries_discrete": [half]}, "4": {"diameter": 1}}))
    assert find_declared(mesh, "obj_000003", 0.001) == (file, 2)
    assert find_declared(mesh, "obj_000004", 0.001) is None
    assert find_declared(mesh, "valve", 0.001) is None  # as symmetries=FILE would not find it
    assert find_declared(tmp_path / "none.ply", "obj_000003", 0.001) is None
