"""Results of several instances, scored by the command: the true poses and what is made of them."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from tests.data.dataset_trees import bop_scene, pose, write_mesh

from posefilter.cli.command import run_command
from posefilter.cli.evaluate import warn_of_several
from posefilter.data.module import PoseDataModule
from posefilter.data.readers.registry import open_reader
from posefilter.meshes.store import MeshStore
from posefilter.metrics.bop_results import PoseRow, to_native, write_poses_csv
from posefilter.metrics.bop_targets import Target
from posefilter.metrics.image_errors import FILE, read_errors
from posefilter.synthetic.generate import generate


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return two frames with two cartons each."""
    out = tmp_path_factory.mktemp("bop") / "scenes"
    generate(
        out,
        2,
        object="carton",
        instances=2,
        size=(160, 120),
        distractors=(0, 1),
        workers=1,
        sensor="ideal",
        progress=False,
    )
    return out


def list_truths(root: Path) -> list[PoseRow]:
    """Return the true poses as estimates, whose scores say nothing of which instance they are."""
    reader = open_reader("fat", root, "carton", MeshStore("builtin"))
    rows = []
    for i, record in enumerate(reader.records()):
        pose = to_native(reader.read(i).camera_from_object, reader.native_from_mesh("carton"))
        ids = (record.scene_id, record.im_id, record.obj_id)
        rows.append(PoseRow(*ids, 0.5 + 0.1 * ((i + 1) % 2), pose, 1.0))
    return rows


def evaluate(  # type: ignore[type-arg]
    rows: list[PoseRow], scenes: Path, out: Path, targets: str = "all", *more: str
) -> dict:
    out.mkdir()
    write_poses_csv(out / "poses.csv", rows)
    typed = [
        f"estimates={out / 'poses.csv'}",
        "data=fat",
        f"data.root={scenes}",
        "data.object=carton",
        "data.meshes=builtin",
        f"targets={targets}",
        f"out={out / 'scores'}",
        "console=json",
        *more,
    ]
    assert run_command("evaluate", arguments=typed) == 0
    content: dict = json.loads((out / "scores" / "metrics.json").read_text())  # type: ignore[type-arg]
    return content


def test_each_instance_is_scored_by_the_estimate_that_is_nearest(
    scenes: Path, tmp_path: Path
) -> None:
    rows = list_truths(scenes)
    assert len(rows) == 4
    right = evaluate(rows, scenes, tmp_path / "right")
    assert right["instances"] == 4
    assert right["missed"] == 0
    assert right["add"]["median_mm"] < 0.01
    assert right["bop"]["ar"] == 100
    assert right["bop"]["targets"] == 4
    # the best of each frame thrice: the other instance is missed, whatever the rest may say
    best = [max(rows[k : k + 2], key=lambda row: row.score) for k in (0, 2)]
    again = [one._replace(score=one.score - 0.01 * k) for one in best for k in range(3)]
    missed = evaluate(again, scenes, tmp_path / "missed")
    assert missed["bop"]["ar_mssd"] == pytest.approx(50, abs=10)
    assert missed["bop"]["estimates"] == 4  # as many of an image as there are instances
    assert missed["add"]["recall_01d"] == pytest.approx(50)


@pytest.mark.parametrize("limit", [1, 2, 3])
def test_of_some_instances_of_an_image_each_has_its_own_estimate(
    limit: int, scenes: Path, tmp_path: Path
) -> None:
    rows = list_truths(scenes)
    some = evaluate(rows, scenes, tmp_path / "some", "all", f"data.limit_test={limit}")
    assert some["instances"] == limit
    assert some["missed"] == 0
    assert some["add"]["median_mm"] < 0.01
    assert some["bop"]["ar"] == 100
    assert some["bop"]["targets"] % 2 == 0  # whole images


def test_the_table_of_errors_has_each_number_in_its_column(scenes: Path, tmp_path: Path) -> None:
    rows = [one._replace(seconds=0.25) for one in list_truths(scenes)[:3]]
    rows[0].camera_from_native[2, 3] += 0.01
    evaluate(rows, scenes, tmp_path / "one")
    table = read_errors(tmp_path / "one" / "scores" / FILE)
    assert sorted(row.add_mm for row in table) == pytest.approx([0, 0, 10, math.inf], abs=0.01)
    for row in table:
        known = math.isfinite(row.add_mm)
        assert row.add_up_to_symmetry_mm == row.add_mm  # it has no symmetries
        assert math.isnan(row.score) != known
        assert not known or row.score == pytest.approx(0.55, abs=0.06)
        assert not known or row.seconds == 0.25
        for name in ("particles_on_object", "presence", "probability", "credible_rank"):
            assert math.isnan(getattr(row, name))


def test_estimates_have_errors_by_visibility_as_a_method_has(scenes: Path, tmp_path: Path) -> None:
    """Of the images of a range alone; a missed one is infinitely off."""
    found = evaluate(list_truths(scenes)[:3], scenes, tmp_path / "one")
    table = read_errors(tmp_path / "one" / "scores" / FILE)
    assert found["by_visibility"]
    for name, own in found["by_visibility"].items():
        low, high = map(float, name.split("-"))
        inside = [
            row for row in table if low <= row.visibility < high or row.visibility == high == 1
        ]
        assert own["instances"] == len(inside)
        near = sum(row.add_mm < 20 for row in inside)
        assert own["add"]["recall_2cm"] == pytest.approx(100 * near / len(inside))
    assert any(own["add"]["recall_2cm"] < 100 for own in found["by_visibility"].values())


def test_a_file_of_targets_says_how_many_count(scenes: Path, tmp_path: Path) -> None:
    rows = list_truths(scenes)
    first = rows[0]
    shifted = first.camera_from_native.copy()
    shifted[:3, 3] += np.array([0.0, 0.0, 5.0])
    path = tmp_path / "targets.json"
    target = Target(first.scene_id, first.im_id, first.obj_id, 2)
    path.write_text(json.dumps([target._asdict()]))
    only = [one for one in rows if one.im_id == first.im_id]
    found = evaluate(only, scenes, tmp_path / "one", str(path))
    assert found["bop"]["targets"] == 2
    assert found["bop"]["ar"] == 100
    assert found["instances"] == 2  # the other scores are of the targets' images, too
    wrong = [only[0]._replace(camera_from_native=shifted), only[1]]
    half = evaluate(wrong, scenes, tmp_path / "half", str(path))
    assert half["bop"]["ar"] == pytest.approx(50)


def test_an_instance_of_which_nothing_is_seen_is_no_target(tmp_path: Path) -> None:
    """And without `data.object=`, the targets' objects are meant."""
    truths, hidden = pose(), pose(position=(0.0, 0.0, 2.0))
    bop_scene(tmp_path / "bop" / "000003", [[(5, hidden), (5, truths)]])
    write_mesh(tmp_path / "meshes", "obj_000005")
    targets = tmp_path / "targets.json"
    targets.write_text(json.dumps([{"scene_id": 3, "im_id": 0, "obj_id": 5, "inst_count": 1}]))
    write_poses_csv(tmp_path / "poses.csv", [PoseRow(3, 0, 5, 1.0, truths, 1.0)])
    typed = [f"estimates={tmp_path / 'poses.csv'}", f"targets={targets}", "console=json"]
    typed += ["data=bop", f"data.root={tmp_path / 'bop'}", f"data.meshes={tmp_path / 'meshes'}"]
    typed += ["data.mesh_scale=1", "data.on_error=skip", f"out={tmp_path / 'out'}"]
    assert run_command("evaluate", arguments=typed) == 0
    found = json.loads((tmp_path / "out" / "metrics.json").read_text())["bop"]
    assert found["targets"] == 1
    assert found["ar"] > 99


def test_a_target_of_an_object_that_was_left_out_is_named(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    bop_scene(tmp_path / "bop" / "000003", [[(5, pose()), (6, pose(position=(0.1, 0.0, 0.5)))]])
    targets = tmp_path / "targets.json"
    targets.write_text(json.dumps([{"scene_id": 3, "im_id": 0, "obj_id": 6, "inst_count": 1}]))
    write_poses_csv(tmp_path / "poses.csv", [PoseRow(3, 0, 5, 1.0, pose(), 1.0)])
    write_mesh(tmp_path / "meshes", "obj_000005")
    typed = [f"estimates={tmp_path / 'poses.csv'}", f"targets={targets}", "console=json"]
    typed += ["data=bop", f"data.root={tmp_path / 'bop'}", f"data.meshes={tmp_path / 'meshes'}"]
    typed += ["data.mesh_scale=1", "data.object=obj_000005", f"out={tmp_path / 'out'}"]
    assert run_command("evaluate", arguments=typed) == 2
    assert "data.object=null takes all objects" in capfd.readouterr().err


def test_an_estimate_an_image_is_not_compared_with_several_instances_without_a_word(
    scenes: Path,
) -> None:
    data = PoseDataModule("fat", scenes, "carton", split={"test": 1.0}, workers=0, progress=False)
    data.setup("test")
    said: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "posefilter.cli.console.say", lambda console, event, text, **_: said.append(text)
        )
        warn_of_several(data, "json")
    (line,) = said
    assert "2 of 2 images show several instances of the object" in line


def test_estimates_of_the_meshs_frame_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """FAT's own object frame is turned against the mesh file's."""
    scenes = tmp_path / "scenes"
    generate(scenes, 2, object="carton", workers=1, sensor="ideal", progress=False)
    rows = list_truths(scenes)
    evaluate(rows, scenes, tmp_path / "right")
    assert "warning" not in capsys.readouterr().out
    reader = open_reader("fat", scenes, "carton", MeshStore("builtin"))
    native = reader.native_from_mesh("carton")
    of_mesh = [one._replace(camera_from_native=one.camera_from_native @ native) for one in rows]
    assert evaluate(of_mesh, scenes, tmp_path / "wrong")["add"]["median_mm"] > 100
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    (warning,) = [line for line in lines if line["event"] == "warning"]
    assert warning["median_mm_in_mesh_frame"] < 0.01


def test_times_that_differ_within_an_image_are_named(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """BOP's toolkit refuses them."""
    rows = list_truths(scenes)
    found = evaluate(rows, scenes, tmp_path / "same")
    assert found["seconds_per_image"] == 1.0
    assert "warning" not in capsys.readouterr().out
    apart = [row._replace(seconds=0.5 + k) for k, row in enumerate(rows)]
    evaluate(apart, scenes, tmp_path / "apart")
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    (warning,) = [line for line in lines if line["event"] == "warning"]
    assert warning["images"] == 2


def test_of_equal_scores_the_first_estimate_counts(scenes: Path, tmp_path: Path) -> None:
    """As the challenge's own scoring has it, whose sort is stable: methods without confidences
    list their best estimate first.
    """
    rows = [row._replace(score=1.0) for row in list_truths(scenes)]
    far = []
    for row in rows:
        pose = row.camera_from_native.copy()
        pose[:3, 3] += np.array([0.0, 0.0, 5.0])
        far.append(row._replace(camera_from_native=pose))
    best_first = evaluate([*rows, *far], scenes, tmp_path / "first")
    assert best_first["bop"]["ar"] == 100
    assert best_first["missed"] == 0
    assert best_first["add"]["recall_01d"] == 100
    assert evaluate([*far, *rows], scenes, tmp_path / "last")["bop"]["ar"] == 0


def test_targets_in_images_that_cannot_be_read_are_left_out_where_such_are_skipped(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    scene = tmp_path / "bop" / "test" / "000003"
    bop_scene(scene, [[(5, pose())], [(5, pose())], [(5, pose())]])
    write_mesh(tmp_path / "meshes", "obj_000005")
    sorted((scene / "depth").iterdir())[1].unlink()
    targets = [{"scene_id": 3, "im_id": n, "obj_id": 5, "inst_count": 1} for n in range(3)]
    (tmp_path / "bop" / "targets.json").write_text(json.dumps(targets))
    write_poses_csv(tmp_path / "poses.csv", [PoseRow(3, n, 5, 1.0, pose(), 1.0) for n in range(3)])
    typed = [f"estimates={tmp_path / 'poses.csv'}", "targets=targets.json", "data=bop"]
    typed += [f"data.root={tmp_path / 'bop'}", f"data.meshes={tmp_path / 'meshes'}"]
    typed += ["data.options.split=test", "data.mesh_scale=1"]
    assert run_command("evaluate", arguments=[*typed, f"out={tmp_path / 'all'}"]) == 2
    assert "data.on_error=skip leaves such frames out" in capfd.readouterr().err
    skip = [*typed, "data.on_error=skip", f"out={tmp_path / 'out'}"]
    assert run_command("evaluate", arguments=skip) == 0
    found = json.loads((tmp_path / "out" / "metrics.json").read_text())["bop"]
    assert (found["ar"], found["targets"], found["left_out"]) == (100, 2, 1)
    assert "does not compare with the challenge's" in " ".join("".join(capfd.readouterr()).split())


def test_a_file_of_targets_is_the_split_that_is_tested(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """By its name in the dataset; other images are no missed instances, and the average recall is
    printed.
    """
    bop_scene(tmp_path / "bop" / "test" / "000003", [[(5, pose())], [(5, pose())], [(5, pose())]])
    write_mesh(tmp_path / "meshes", "obj_000005")
    target = {"scene_id": 3, "im_id": 1, "obj_id": 5, "inst_count": 1}
    (tmp_path / "bop" / "targets.json").write_text(json.dumps([target]))
    write_poses_csv(tmp_path / "poses.csv", [PoseRow(3, 1, 5, 1.0, pose(), 1.0)])
    typed = [f"estimates={tmp_path / 'poses.csv'}", "targets=targets.json", "data=bop"]
    typed += [f"data.root={tmp_path / 'bop'}", f"data.meshes={tmp_path / 'meshes'}"]
    typed += ["data.options.split=test", "data.mesh_scale=1"]
    for name, more in {"out": [], "seeded": ["data.split_seed=1"]}.items():
        assert run_command("evaluate", arguments=[*typed, *more, f"out={tmp_path / name}"]) == 0
        found = json.loads((tmp_path / name / "metrics.json").read_text())
        assert (found["instances"], found["missed"], found["bop"]["targets"]) == (1, 0, 1)
        assert found["add"]["recall_01d"] == 100
    assert "BOP average recall" in capfd.readouterr().out
    wrong = [one.replace("targets.json", "none.json") for one in typed[:-1]]
    assert run_command("evaluate", arguments=[*wrong, f"out={tmp_path / 'other'}"]) == 2
    assert "targets=none.json: no such file, nor in data.root=" in capfd.readouterr().err
