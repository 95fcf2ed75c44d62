"""Scenes of one mesh are not learned from as if they were of another."""

from dataclasses import replace
from pathlib import Path

import pytest
from omegaconf import DictConfig
from tests.data.dataset_trees import fat_folder, fat_frame, pose

from posefilter.cli.build import build_data
from posefilter.cli.command import compose_job
from posefilter.cli.train import build
from posefilter.errors import UserError
from posefilter.meshes.builtin import catalog
from posefilter.meshes.write import write_obj
from posefilter.paths import find_conf


def test_scenes_of_another_mesh_are_refused(tmp_path: Path) -> None:
    """In place or in another folder; what was rendered may be kept on purpose."""
    before, after = tmp_path / "before", tmp_path / "after"
    brick = catalog.build("brick")
    write_obj(brick, before / "brick")
    write_obj(catalog.build("brick"), after / "brick")
    (obj,) = (after / "brick").rglob("*.obj")
    lines = obj.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("v "))
    lines[first] = "v 0.09 0.01 0.02"
    obj.write_text("\n".join(lines) + "\n")

    def settings(meshes: Path, *more: str) -> DictConfig:
        words = [
            "data=scenes", f"data.root={tmp_path / 'scenes'}", f"data.meshes={meshes}",
            "data.object=brick", "data.generate.frames=2", "data.generate.size=[96,72]",
            "data.generate.workers=1", "data.generate.distractors=[0,0]", "data.workers=0", *more,
        ]  # fmt: skip
        return compose_job("train", find_conf(), words, Path()).cfg.data

    build_data(settings(before), "json")
    build_data(settings(before), "json")
    told = r"scenes: its scenes show another mesh of brick than data.meshes=.*after has now"
    with pytest.raises(UserError, match=told):
        build_data(settings(after), "json")
    build_data(settings(after, "data.generate=null"), "json")
    # another print on the same shape is another mesh, too
    print_ = tmp_path / "print"
    write_obj(replace(brick, texture=255 - brick.texture), print_ / "brick")
    with pytest.raises(UserError, match=r"another mesh of brick than .*print has now"):
        build_data(settings(print_), "json")
    before.rename(tmp_path / "old")
    after.rename(before)
    with pytest.raises(UserError, match="another mesh of brick"):
        build_data(settings(before), "json")


def test_a_training_of_several_classes_is_refused(tmp_path: Path) -> None:
    """It would learn the first from images of all."""
    for number in range(3):
        folder = fat_folder(tmp_path / "mixed" / f"room_{number}", {"carton": 24, "brick": 36})
        poses = (pose(position=(x, 0.0, 0.5)) for x in (-0.08, 0.08))
        fat_frame(folder, 0, [("carton", 24, next(poses)), ("brick", 36, next(poses))])
    words = ["data=fat", f"data.root={tmp_path}", "data.meshes=builtin", "debug=smoke"]
    for one in ("null", "[brick,carton]"):
        job = compose_job("train", find_conf(), [*words, f"data.object={one}"], tmp_path / "out")
        with pytest.raises(UserError, match="a method learns one object, and the data have brick"):
            build(job)
