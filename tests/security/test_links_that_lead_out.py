"""A folder of somebody else's may have links: nothing outside of it is removed or written."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from posefilter.cli.command import run_command
from posefilter.data.cache import DiskCache
from posefilter.errors import UserError
from posefilter.files import remove_parts
from posefilter.synthetic.generate import generate

HOME = Path(__file__).parents[2]
SETTINGS: dict[str, Any] = {
    "object": "carton", "workers": 1, "size": (64, 48), "distractors": (0, 1),
    "frames_per_scene": 2, "progress": False,
}  # fmt: skip


def fill(folder: Path) -> dict[Path, bytes]:
    """Put files where nothing may be changed; return them."""
    for name in ("file.txt", ".x.part", "scene_mine_0/file.txt", "scene_mine_0/.x.part"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("private")
    return read_all(folder)


def read_all(folder: Path) -> dict[Path, bytes]:
    return {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def check_kept(files: dict[Path, bytes]) -> None:
    """Check that files are as they were, and none has come to them."""
    folder = Path(os.path.commonpath([*files]))
    assert read_all(folder) == files


@pytest.mark.parametrize("place", ["checkpoints", "figures", "beliefs"])
def test_what_a_killed_writer_left_is_removed_within_the_folder_alone(
    place: str, tmp_path: Path
) -> None:
    kept = fill(tmp_path / "outside")
    run = tmp_path / "run"
    (run / "own").mkdir(parents=True)
    for part in (run / ".x.part", run / "own" / ".x.part"):
        part.write_text("")
    (run / place).symlink_to("../outside")
    remove_parts(run, (".", "*"))
    check_kept(kept)
    assert {path.name for path in run.iterdir()} == {"own", place}
    assert not list((run / "own").iterdir())


@pytest.mark.parametrize("link", ["metrics_train.json", "errors_train.csv", "figures", "beliefs"])
@pytest.mark.parametrize("what", ["checkpoint", "estimates"])
def test_an_evaluation_in_a_run_of_links_changes_nothing(
    link: str,
    what: str,
    content: dict[str, Any],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    kept = fill(tmp_path / "outside")
    run = tmp_path / "run"
    (run / "checkpoints").mkdir(parents=True)
    (run / "metrics.json").write_text("{}")
    (run / "errors.csv").write_text("x")
    file = "file.txt" if link.endswith(("json", "csv")) else ""
    (run / link).symlink_to(tmp_path / "outside" / file)
    torch.save(content, run / "checkpoints" / "best.ckpt")
    (run / "checkpoints" / "poses.csv").write_text("scene_id,im_id,obj_id,score,R,t,time\n")
    given = f"{what}={run}/checkpoints/{'best.ckpt' if what == 'checkpoint' else 'poses.csv'}"
    data = ["data=fat", f"data.root={tmp_path}", "data.object=carton", "console=json"]
    assert run_command("evaluate", HOME, [given, *data]) == 2
    assert f"{run / link}: is a link that leads out of {run}" in capfd.readouterr().err
    check_kept(kept)


@pytest.mark.parametrize("begun", [False, True])
def test_scenes_are_not_rendered_into_what_a_dataset_links_to(begun: bool, tmp_path: Path) -> None:
    """A record alone, of an earlier start that failed, has its folders of scenes removed."""
    kept = fill(tmp_path / "outside")
    whole, data = tmp_path / "whole", tmp_path / "data"
    generate(whole, 2, **SETTINGS)
    data.mkdir()
    shutil.copy(whole / "_generator.json", data)
    if begun:
        shutil.copytree(whole / "mixed", tmp_path / "outside", dirs_exist_ok=True)
        kept = read_all(tmp_path / "outside")
    (data / "mixed").symlink_to("../outside")
    with pytest.raises(UserError, match=r"mixed: is a link that leads out of .*/data"):
        generate(data, 4, **SETTINGS)
    check_kept(kept)


def test_an_onboarding_of_links_is_not_gone_on_with(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    kept = fill(tmp_path / "outside")
    out = tmp_path / "out"
    out.mkdir()
    (out / "onboard.json").write_text(json.dumps({}))
    for name in ("training", "meshes", "checkpoints"):
        (out / name).symlink_to(tmp_path / "outside")
    assert run_command("onboard", HOME, ["mesh=carton", f"out={out}", "console=json"]) == 2
    assert f"is a link that leads out of {out}" in capfd.readouterr().err
    check_kept(kept)


@pytest.mark.parametrize("what", ["README", "00", ""])
def test_a_cache_that_a_dataset_brings_leads_nowhere(what: str, tmp_path: Path) -> None:
    kept = fill(tmp_path / "outside")
    folder = tmp_path / "data" / ".cache" / DiskCache(tmp_path / "own", "x").folder.name
    (folder / what).parent.mkdir(parents=True)
    (folder / what).symlink_to(tmp_path / "outside" / ("file.txt" if what == "README" else ""))
    with pytest.raises(UserError, match="leads out of") as caught:
        DiskCache(tmp_path / "data" / ".cache", "x")
    assert "\n" not in str(caught.value)
    check_kept(kept)
