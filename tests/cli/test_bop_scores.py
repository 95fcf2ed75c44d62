"""Results of several instances, scored by the command: the true poses and what is made of them."""

import json
from pathlib import Path

import numpy as np
import pytest

from posefilter.cli.command import run_command
from posefilter.data.readers.registry import open_reader
from posefilter.meshes.store import MeshStore
from posefilter.metrics.bop_results import PoseRow, to_native, write_poses_csv
from posefilter.metrics.bop_targets import Target
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


def evaluate(rows: list[PoseRow], scenes: Path, out: Path, targets: str = "all") -> dict:  # type: ignore[type-arg]
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
    assert found["instances"] == 4  # the other scores are of all instances
    wrong = [only[0]._replace(camera_from_native=shifted), only[1]]
    half = evaluate(wrong, scenes, tmp_path / "half", str(path))
    assert half["bop"]["ar"] == pytest.approx(50)
