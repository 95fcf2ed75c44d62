"""Stages: what is done is not done again, what follows a change is, and what is costly is kept."""

import json
from pathlib import Path
from typing import Any

import pytest

from posefilter.cli.onboard import FOUND
from posefilter.cli.stages import Stages
from posefilter.errors import UserError


def test_what_follows_a_change_is_done_again(tmp_path: Path) -> None:
    file, done = tmp_path / "record.json", list[str]()
    for name in ("look", "render", "train"):
        Stages(file).run(name, {"size": 1}, lambda name=name: done.append(name))
    kept = Stages(file)
    assert all(kept.is_done(name, {"size": 1}) for name in ("look", "render", "train"))
    assert not kept.is_done("look", {"size": 2})
    kept.run("look", {"size": 2}, lambda: None)
    again = Stages(file)
    assert [again.is_done(name, {"size": 1}) for name in ("render", "train")] == [False, False]
    assert again.is_done("look", {"size": 2})
    assert done == ["look", "render", "train"]


def test_an_interrupted_stage_is_not_done_and_its_time_counts(tmp_path: Path) -> None:
    stages = Stages(tmp_path / "record.json")

    def stop() -> None:
        stages.keep(steps=7)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stages.run("train", {}, stop)
    spent = stages.seconds["train"]
    again = Stages(tmp_path / "record.json")
    assert not again.is_done("train", {})
    assert again.values == {"steps": 7}
    again.run("train", {}, lambda: None)
    assert again.is_done("train", {})
    assert again.seconds["train"] > spent > 0


def test_a_costly_stage_is_not_begun_anew(tmp_path: Path) -> None:
    stages = Stages(tmp_path / "record.json")
    stages.run("train", {"steps": 5, "seed": 0}, lambda: None, costly=True)
    with pytest.raises(UserError, match=r"'train' was begun with other settings \(steps\)"):
        stages.run("train", {"steps": 6, "seed": 0}, lambda: None, costly=True)


def test_settings_of_a_record_have_the_names_of_today(tmp_path: Path) -> None:
    file = tmp_path / "record.json"
    typed = ["filter.particles=8", "filter.zoom_diameter=0.3"]
    before = {"clutter": "builtin", "clutter_scale": None, "settings": typed}
    stage = {"done": True, "settings": before, "seconds": 1.5}
    file.write_text(json.dumps({"stages": {"render": stage}, "values": {}}))
    words = ["filter.particles=8", "filter.magnified_width=0.3"]
    now = {"distractor_meshes": "builtin", "train_overrides": words}
    assert Stages(file).is_done("render", {**now, "distractor_scale": None})


STAGE = {"done": True, "settings": {}, "seconds": 1.5}


@pytest.mark.parametrize(
    ("stages", "values", "told"),
    [
        ([1], {}, "its stages should be a mapping"),
        ({"mesh": 5}, {}, "its stages.mesh should be a mapping"),
        ({"mesh": {}}, {}, "its stages.mesh has no settings"),
        ({"mesh": {**STAGE, "seconds": "x"}}, {}, "its stages.mesh.seconds should be a number"),
        ({"mesh": {**STAGE, "seconds": float("nan")}}, {}, "NaN cannot be computed with"),
        ({}, {"steps": []}, "its values.steps should be a number"),
        ({}, {"training": 5}, "its values.training should be a mapping"),
    ],
)
def test_a_damaged_record_is_named(stages: Any, values: Any, told: str, tmp_path: Path) -> None:
    file = tmp_path / "record.json"
    file.write_text(json.dumps({"stages": stages, "values": values}))
    with pytest.raises(UserError, match=rf"record\.json: is no record.*{told}"):
        Stages(file, FOUND)


def test_what_is_no_record_is_named(tmp_path: Path) -> None:
    for content in ("[]", "[" * 100_000, "{}", "{"):
        (tmp_path / "record.json").write_text(content)
        with pytest.raises(UserError, match=r"record\.json: is no record"):
            Stages(tmp_path / "record.json")


def test_other_settings_are_refused_before_anything_is_done(tmp_path: Path) -> None:
    file = tmp_path / "record.json"
    Stages(file).run("look", {"mesh": "a"}, lambda: None)
    Stages(file).run("train", {"mesh": "a"}, lambda: None, costly=True)
    before = file.read_text()
    stages = Stages(file)
    stages.check("train", {"mesh": "a"})
    stages.check("never", {"mesh": "b"})
    with pytest.raises(UserError, match=r"'train' was begun with other settings \(mesh\)"):
        stages.check("train", {"mesh": "b"})
    assert file.read_text() == before
