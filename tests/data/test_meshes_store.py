"""The mesh store: layouts, names, units, symmetries."""

import json
import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import trimesh

from posefilter.errors import UserError
from posefilter.meshes import ycb
from posefilter.meshes.store import MeshStore, symmetry_group
from posefilter.meshes.symmetries import rotation_about

HALF = np.diag([-1.0, -1.0, 1.0, 1.0])  # half a turn about z


BOWL = np.linalg.inv(ycb.bop_from_original("024_bowl"))[:3, 3]  # the center of YCB's


def _box(
    path: Path,
    size: tuple[float, float, float] = (0.1, 0.2, 0.3),
    center: Sequence[float] = (0, 0, 0),
) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    box = trimesh.creation.box(size)
    box.apply_translation(center)
    box.export(path)
    return path


def _fails(store: MeshStore, name: str) -> str:
    with pytest.raises(UserError) as caught:
        store.load(name)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_all_layouts_are_found(tmp_path: Path) -> None:
    _box(tmp_path / "003_cracker_box" / "google_16k" / "textured.obj", (0.1, 0.1, 0.11))
    # the YCB layout goes first
    _box(tmp_path / "003_cracker_box" / "textured.ply", (0.1, 0.1, 0.12))
    _box(tmp_path / "tin" / "textured.glb")
    _box(tmp_path / "tin" / "other.ply")  # textured.* goes first
    _box(tmp_path / "cup" / "scan.PLY".lower(), (0.1, 0.1, 0.13))
    _box(tmp_path / "flat.obj", (0.1, 0.1, 0.14))
    (tmp_path / "pictures").mkdir()
    (tmp_path / "notes.txt").write_text("")
    store = MeshStore(tmp_path)
    assert store.names() == ["003_cracker_box", "cup", "flat", "tin"]
    heights = {name: float(np.ptp(store.load(name).vertices[:, 2])) for name in store.names()}
    assert heights == pytest.approx(
        {"003_cracker_box": 0.11, "cup": 0.13, "flat": 0.14, "tin": 0.3}
    )
    assert store.load("tin") is store.load("tin")
    assert store.load("tin").name == "tin"


def test_of_one_mesh_in_several_formats_the_same_is_taken_in_any_layout(tmp_path: Path) -> None:
    for folder in (tmp_path / "flat", tmp_path / "folders" / "tin"):
        _box(folder / "tin.glb", (0.1, 0.1, 0.2))
        _box(folder / "tin.obj", (0.1, 0.1, 0.12))
    for root in (tmp_path / "flat", tmp_path / "folders"):
        assert np.ptp(MeshStore(root).load("tin").vertices[:, 2]) == pytest.approx(0.12)


def test_what_a_mac_puts_beside_a_file_is_no_mesh(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "mug"):
        folder.mkdir(exist_ok=True)
        trimesh.creation.box([0.1, 0.1, 0.1]).export(folder / "box.ply")
        (folder / "._box.ply").write_bytes(b"Mac OS X")
    store = MeshStore(tmp_path)
    assert store.names() == ["box", "mug"]
    assert len(store.load("mug").faces) == 12


def test_a_mesh_without_a_hull_is_named_by_its_file(tmp_path: Path) -> None:
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n")
    message = _fails(MeshStore(tmp_path), "flat")
    assert message == f"{tmp_path / 'flat.obj'}: has 3 vertices; an object has 4 or more"


def test_unknown_names_say_the_nearest(tmp_path: Path) -> None:
    _box(tmp_path / "003_cracker_box.obj")
    assert "'003_cracker_box'" in _fails(MeshStore(tmp_path), "cracker_box")
    assert "'carton'" in _fails(MeshStore("builtin"), "cartn")
    assert "carton, coffee_can" in _fails(MeshStore("builtin"), "q")


def test_empty_and_ambiguous_folders_are_named(tmp_path: Path) -> None:
    for root, word in ((tmp_path / "no", "no such folder"), (tmp_path, "no meshes here")):
        with pytest.raises(UserError, match=word):
            MeshStore(root)
    _box(tmp_path / "two" / "a.ply")
    _box(tmp_path / "two" / "a.obj", (0.1, 0.1, 0.11))
    # one mesh in two formats
    assert np.ptp(MeshStore(tmp_path).load("two").vertices[:, 2]) == pytest.approx(0.11)
    _box(tmp_path / "two" / "b.obj")
    _box(tmp_path / "other.obj")
    store = MeshStore(tmp_path)  # only the mesh that is needed is judged
    assert store.names() == ["other"]
    assert store.load("other").name == "other"
    assert "two: 3 meshes" in _fails(store, "two")


def test_units_are_not_guessed(tmp_path: Path) -> None:
    _box(tmp_path / "mm.obj", (100, 200, 300))
    _box(tmp_path / "tiny.obj", (1e-4, 2e-4, 3e-4))
    store = MeshStore(tmp_path)
    assert "millimeters" in _fails(store, "mm")
    assert (
        "data.mesh_scale=0.001 (generate, check_data, predict, track: mesh_scale=0.001)"
        in _fails(store, "mm")
    )
    assert "or 0.01 of centimeters, 0.0254 of inches" in _fails(store, "mm")
    assert "data.mesh_scale=1000" in _fails(store, "tiny")
    twice = MeshStore(tmp_path, scale=1e-6)
    assert "data.mesh_scale=0.001 " in _fails(twice, "mm")
    assert "in kilometers" in _fails(store, "tiny")
    assert "in meters, and taken as 1e-06 m a unit" in _fails(twice, "mm")
    for scale in (0, -1, float("nan"), "x"):
        with pytest.raises(UserError, match="mesh_scale="):
            MeshStore(tmp_path, scale=scale)
    assert np.ptp(MeshStore(tmp_path, scale=0.001).load("mm").vertices, axis=0) == pytest.approx(
        [0.1, 0.2, 0.3]
    )


def test_symmetries_come_from_the_argument_then_the_file_then_the_table(tmp_path: Path) -> None:
    _box(tmp_path / "obj_000013.ply", (100, 100, 300))
    _box(tmp_path / "obj_000002.ply", (100, 200, 300))
    far = HALF.copy()
    far[:3, 3] = [20.0, 0, 0]
    info = {
        "13": {"diameter": 300, "symmetries_discrete": [far.ravel().tolist()]},
        "2": {"diameter": 300},
    }
    (tmp_path / "models_info.json").write_text(json.dumps(info))
    store = MeshStore(tmp_path, scale=0.001)
    assert store.load("obj_000002").symmetries.tolist() == [np.eye(4).tolist()]
    read = store.load("obj_000013").symmetries
    assert read.shape == (2, 4, 4)
    assert read[0].tolist() == np.eye(4).tolist()
    assert read[1, :3, 3].tolist() == pytest.approx([0.02, 0, 0])  # millimeters, as the mesh
    given = MeshStore(tmp_path, scale=0.001, symmetries={"obj_000013": np.stack([HALF, np.eye(4)])})
    assert np.array_equal(given.load("obj_000013").symmetries, np.stack([np.eye(4), HALF]))


def test_a_folder_of_its_own_may_say_its_symmetries(tmp_path: Path) -> None:
    _box(tmp_path / "024_bowl" / "textured.obj", center=BOWL)
    table = MeshStore(tmp_path).load("024_bowl").symmetries
    assert table == pytest.approx(ycb.symmetries("024_bowl"))
    own = {
        "symmetries_discrete": [],
        "symmetries_continuous": [{"axis": [0, 0, 2], "offset": [0.01, 0, 0]}],
    }
    (tmp_path / "024_bowl" / "symmetries.json").write_text(json.dumps(own))
    read = MeshStore(tmp_path, symmetry_steps=4).load("024_bowl").symmetries
    assert len(read) == 4
    quarter = read[1] @ [0.03, 0, 0, 1]
    assert quarter == pytest.approx([0.01, 0.02, 0, 1])  # about the line through the offset
    del own["symmetries_discrete"]  # as BOP's own entries have it
    (tmp_path / "024_bowl" / "symmetries.json").write_text(json.dumps(own))
    again = MeshStore(tmp_path, symmetry_steps=4).load("024_bowl").symmetries
    assert np.array_equal(again, read)


@pytest.mark.parametrize("name", ["024_bowl", "051_large_clamp", "061_foam_brick"])
@pytest.mark.parametrize("frame", ["google_16k", "YCB-Video", "BOP"])
def test_known_symmetries_follow_the_frame_of_the_mesh(
    name: str, frame: str, tmp_path: Path
) -> None:
    """YCB-Video's and BOP's models are shifted against those that the table was measured on."""
    moves = {
        "google_16k": np.eye(4),
        "YCB-Video": ycb.ycbvideo_from_original(name),
        "BOP": ycb.bop_from_original(name),
    }
    to_bop = ycb.bop_from_original(name)  # in whose frame the box lies about the origin
    place = moves[frame]
    _box(tmp_path / name / "textured.obj", center=(place @ np.linalg.inv(to_bop))[:3, 3])
    found = MeshStore(tmp_path).load(name).symmetries
    table = ycb.symmetries(name)
    assert table is not None
    points = np.random.default_rng(0).normal(size=(4, 20))
    points[3] = 1
    for turn, known in zip(found, table, strict=True):
        np.testing.assert_allclose(turn @ place @ points, place @ known @ points, atol=1e-12)


def test_known_symmetries_and_parts_are_left_out_where_the_frame_is_unknown(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    _box(tmp_path / "051_large_clamp" / "textured.obj", center=(0.3, 0, 0))
    _box(tmp_path / "003_cracker_box" / "textured.obj", center=(0.3, 0, 0))
    with caplog.at_level(logging.WARNING):
        store = MeshStore(tmp_path)
        assert len(store.load("003_cracker_box").symmetries) == 1
        assert caplog.messages == []  # it has none to leave out
        assert len(store.load("051_large_clamp").symmetries) == 1
        assert store.load("051_large_clamp").parts == {}
    assert "its frame is none of those that YCB, YCB-Video and BOP have" in caplog.messages[0]


@pytest.mark.parametrize("moved", [False, True])
def test_known_parts_follow_the_frame_of_the_mesh(moved: bool, tmp_path: Path) -> None:
    name = "051_large_clamp"
    place = ycb.ycbvideo_from_original(name) if moved else np.eye(4)
    center = (place @ np.linalg.inv(ycb.bop_from_original(name)))[:3, 3]
    path = tmp_path / name / "textured.obj"
    path.parent.mkdir(parents=True)
    box = trimesh.creation.box((0.05, 0.2, 0.03)).subdivide_loop(4)
    box.apply_translation(center - box.bounds.mean(axis=0))
    box.export(path)
    mesh = MeshStore(tmp_path).load(name)
    low = mesh.vertices[mesh.faces[mesh.parts["handles"]]][..., 1].mean(axis=1).min()
    assert low - place[1, 3] == pytest.approx(-0.013, abs=0.01)


@pytest.mark.parametrize("file", ["symmetries.json", "parts.json"])
def test_a_file_that_names_no_object_is_not_of_all_in_its_folder(file: str, tmp_path: Path) -> None:
    entry = {"symmetries_continuous": [{"axis": [0, 0, 1]}]}
    foot = {"foot": {"box": [[-9, -9, -9], [9, 9, 9]]}}
    (tmp_path / file).write_text(json.dumps(entry if file == "symmetries.json" else foot))
    _box(tmp_path / "can.ply")
    mesh = MeshStore(tmp_path).load("can")  # of whom else could it be?
    assert len(mesh.symmetries) > 1 or set(mesh.parts) == {"foot"}
    _box(tmp_path / "carton.ply")
    assert "does not say of which of 2 objects it is" in _fails(MeshStore(tmp_path), "carton")
    (tmp_path / "tin").mkdir()
    (tmp_path / file).rename(tmp_path / "tin" / file)
    _box(tmp_path / "tin" / "tin.ply")
    mesh = MeshStore(tmp_path).load("tin")
    assert len(mesh.symmetries) > 1 or set(mesh.parts) == {"foot"}
    assert len(MeshStore(tmp_path).load("can").symmetries) == 1


def test_a_file_about_other_objects_hides_no_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("024_bowl", "my_can"):
        _box(tmp_path / name / "textured.obj", center=BOWL)
    turn = {"symmetries_continuous": [{"axis": [0, 0, 1]}]}
    (tmp_path / "symmetries.json").write_text(json.dumps({"my_can": turn}))
    half = {"symmetries_discrete": [HALF.reshape(-1).tolist()]}
    table = ycb.symmetries("024_bowl")
    assert MeshStore(tmp_path).load("024_bowl").symmetries == pytest.approx(table)
    assert len(MeshStore(tmp_path, symmetry_steps=8).load("my_can").symmetries) == 8
    (tmp_path / "models_info.json").write_text(json.dumps({"024_bowl": half}))
    assert len(MeshStore(tmp_path).load("024_bowl").symmetries) == 2
    (tmp_path / "parts.json").write_text(
        json.dumps({"my_can": {"lid": {"box": [[-9, -9, -9], [9, 9, 9]]}}})
    )
    known = {"rim": np.ones(12, dtype=bool)}
    monkeypatch.setattr(ycb, "parts", lambda name, mesh: known if name == "024_bowl" else {})
    assert set(MeshStore(tmp_path).load("024_bowl").parts) == {"rim"}
    assert set(MeshStore(tmp_path).load("my_can").parts) == {"lid"}


def test_bad_symmetries_are_named(tmp_path: Path) -> None:
    _box(tmp_path / "a.obj")
    for text in (
        '{"a": {"symmetries_discrete": [[1, 2]]}}',
        "{",
        '{"a": {"symmetries_continuous": [{}]}}',
        '{"a": {"symmetries_continuous": [{"axis": [0, 0, 0]}]}}',
    ):
        (tmp_path / "symmetries.json").write_text(text)
        assert "symmetries.json" in _fails(MeshStore(tmp_path), "a")
    (tmp_path / "symmetries.json").unlink()
    mirror = np.diag([-1.0, 1, 1, 1])
    assert "mirror" in _fails(
        MeshStore(tmp_path, symmetries={"a": np.stack([np.eye(4), mirror])}), "a"
    )
    assert "(S, 4, 4)" in _fails(MeshStore(tmp_path, symmetries={"a": np.eye(4)}), "a")


def test_symmetry_group_is_closed() -> None:
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    group = symmetry_group([flip], [(np.array([0, 0, 3.0]), np.zeros(3))], steps=6)
    assert len(group) == 12
    for a in group:
        for b in group:
            assert np.abs(group - a @ b).max(axis=(1, 2)).min() < 1e-9


def test_a_rotation_keeps_the_points_of_its_axis() -> None:
    axis, point = np.array([0.6, 0, 0.8]), np.array([0.1, 0.2, 0.3])
    turn = rotation_about(axis, 1.0, point)
    assert turn @ [*(point + 0.7 * axis), 1] == pytest.approx([*(point + 0.7 * axis), 1])
    moved = (turn @ [*(point + np.array([0, 1, 0])), 1])[:3] - point
    assert moved @ [0, 1, 0] == pytest.approx(np.cos(1.0))
    assert moved @ np.cross(axis, [0, 1, 0]) == pytest.approx(np.sin(1.0))  # right-handed


def test_an_unknown_mesh_is_refused_with_the_names_there_are(tmp_path: Path) -> None:
    message = _fails(MeshStore("builtin"), "cracker")
    assert "there are banana, bleach_bottle," in message
    assert "data.meshes=DIR" in message
