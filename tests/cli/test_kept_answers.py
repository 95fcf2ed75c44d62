"""What a command leaves of other commands' files, and what it makes of two checkpoints."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from omegaconf import OmegaConf
from tests.data.dataset_trees import bop_scene, pose

from posefilter.checking.check import check_dataset
from posefilter.cli import run_command
from posefilter.cli.checkpoints import check_once
from posefilter.cli.doubts import say_doubt
from posefilter.cli.predict import list_rows
from posefilter.cli.preflight import check_files
from posefilter.cli.track_log import check_unused
from posefilter.data.readers.registry import open_reader
from posefilter.errors import UserError
from posefilter.meshes.store import MeshStore
from posefilter.paths import find_conf

SCENE = Path(__file__).parents[2] / "docs" / "scenes" / "003_cracker_box" / "mixed" / "scene0003_0"


@pytest.mark.parametrize("held", ["metrics.json", "checkpoints"])
def test_tracks_are_not_written_into_a_run(held: str, tmp_path: Path) -> None:
    check_unused(tmp_path)
    (tmp_path / held).mkdir() if held == "checkpoints" else (tmp_path / held).touch()
    with pytest.raises(UserError, match="holds a run"):
        check_unused(tmp_path)


def test_an_evaluation_is_not_written_into_tracks(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for name in ("tracks.csv", "poses.csv", "metrics.json"):
        (tmp_path / name).write_text("{}")
    typed = ["checkpoint=003_cracker_box", f"out={tmp_path}"]
    assert run_command("evaluate", arguments=typed) == 2
    assert "holds tracks" in capfd.readouterr().err
    assert (tmp_path / "metrics.json").read_text() == "{}"


def test_the_poses_of_another_command_are_kept(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "poses.csv").write_text("of an evaluation")
    image = min(SCENE.glob("*.left.jpg"))
    typed = [
        "checkpoint=[003_cracker_box,004_sugar_box]", f"rgb={image}", f"out={tmp_path}",
        f"depth={str(image).replace('left.jpg', 'left.depth.png')}", "depth_scale=10000",
        "intrinsics=300,300,160,120",
    ]  # fmt: skip
    assert run_command("predict", arguments=typed) == 2
    assert "its poses.csv is of another command" in capfd.readouterr().err
    assert (tmp_path / "poses.csv").read_text() == "of an evaluation"


def test_the_time_of_an_image_counts_objects_that_are_absent() -> None:
    seen: Any = SimpleNamespace(
        object="003_cracker_box", probability=None, score=1.0, pose=np.eye(4), seconds=0.25
    )
    (row,) = list_rows([seen], ["003_cracker_box", "004_sugar_box"], 1.5)
    assert row[-1] == 1.5


def test_two_checkpoints_of_one_object_are_told_apart_by_nothing() -> None:
    check_once(["a", "b"])
    with pytest.raises(UserError, match="2 of them are of a;"):
        check_once(["a", "b", "a"])


def test_a_picture_of_an_earlier_dataset_is_no_part_of_a_report(tmp_path: Path) -> None:
    (tmp_path / "report").mkdir()
    (tmp_path / "report" / "contact_sheet.png").touch()
    bop_scene(tmp_path / "data" / "000001", [[(2, pose())]])
    meshes = MeshStore("builtin")  # none of the object
    reader = open_reader("bop", tmp_path / "data", None, meshes)
    check_dataset(reader, meshes, out=tmp_path / "report")
    assert [path.name for path in (tmp_path / "report").iterdir()] == ["data_report.json"]


@pytest.mark.parametrize("file", sorted(find_conf().glob("*.yaml")), ids=lambda file: file.stem)
def test_every_switch_takes_true_and_false_alone(file: Path) -> None:
    """A text such as "no" would count as true."""
    settings = yaml.safe_load(file.read_text())
    for switch in (key for key, value in settings.items() if isinstance(value, bool)):
        with pytest.raises(UserError, match=f"^{switch}=no: choose true or false$"):
            check_files(file.stem, OmegaConf.create({**settings, switch: "no"}))


def test_a_doubt_is_said_once_whatever_its_numbers(capfd: pytest.CaptureFixture[str]) -> None:
    warned: set[str] = set()
    for count in (3, 5):
        blank = f"{count} of 76800 pixels have depth"
        result: Any = SimpleNamespace(
            blank=blank, wrong_size=False, object="box", warnings=(blank,), calibration=None
        )
        say_doubt(result, f"frame {count}", warned, "json")
    (line,) = capfd.readouterr().out.splitlines()
    assert "3 of 76800" in line
