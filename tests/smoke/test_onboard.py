"""Onboarding, the whole way at toy size: it is gone on with where it was interrupted."""

import json
from pathlib import Path

import pytest
from tests.smoke.conftest import SMALL_POSE_PF

from posefilter.cli import onboard as command
from posefilter.cli import run_command
from posefilter.errors import Stopped
from posefilter.meshes.builtin import catalog
from posefilter.meshes.write import write_obj

HOME = Path(__file__).parents[2]
TOY = [
    "mesh=brick",
    "frames=18",
    "steps=4",
    "test_frames=2",
    "warm_start=null",
    "threads=1",
    "workers=1",
    "console=json",
    "train_overrides=['data.image_width=160','data.generate.size=[160,120]','data.batch_size=2',"
    "'data.batch_size_test=2','data.workers=0','data.limit_train=8','filter.particles=16',"
    "'filter.initial_particles=null','filter.steps=2','data.generate.distractors=[1,1]',"
    "'data.num_model_points=200','logger=none','data.limit_val=1','data.generate.frames_per_scene=3',"
    + ",".join(f"'{setting}'" for setting in SMALL_POSE_PF)
    + "]",
]


def told(capsys: pytest.CaptureFixture[str]) -> list[dict]:
    return [json.loads(line) for line in capsys.readouterr().out.splitlines() if line[:1] == "{"]


@pytest.mark.slow
def test_it_goes_on_after_an_interruption(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "brick"
    write_obj(catalog.build("bowl"), tmp_path / "few" / "bowl")
    typed = [*TOY, f"distractor_meshes={tmp_path / 'few'}", f"out={out}"]

    def interrupted(run: object) -> dict:
        raise Stopped(2)

    monkeypatch.setattr(command, "_FEWEST_FRAMES", 12)  # rendered and measured before the others
    with monkeypatch.context() as patch:
        patch.setattr(command, "fit", interrupted)
        assert run_command("onboard", HOME, typed) == 130
    assert len(list((out / "data").rglob("*.left.json"))) == 18
    record = json.loads((out / "onboarding.json").read_text())
    assert [name for name, one in record["stages"].items() if one["done"]] == [
        "mesh",
        "symmetries",
        "render",
    ]
    frame = next((out / "data").rglob("*.left.json"))
    written = frame.stat().st_mtime_ns
    capsys.readouterr()

    # a toy's three validation frames are enough to go the way, if not to calibrate anything
    monkeypatch.setattr(command, "FEWEST", 2)
    monkeypatch.setattr("posefilter.confidence.fit.FEWEST", 2)

    assert run_command("onboard", HOME, typed) == 0
    events = told(capsys)
    stages = {event["stage"]: event["done"] for event in events if event["event"] == "stage"}
    assert [name for name, done in stages.items() if done] == ["mesh", "symmetries", "render"]
    assert frame.stat().st_mtime_ns == written
    assert events[-1]["event"] == "onboarded"
    assert all(Path(file).exists() for file in events[-1]["files"].values())
    metrics = json.loads((out / "training" / "metrics.json").read_text())
    assert metrics["training"]["steps"] == 4
    assert metrics["instances"] == 2
    page = (out / "report" / "report.html").read_text()
    assert "brick: from a mesh to weights</h1>" in page
    assert "The mesh" in page
    assert "Where the time went" in page

    # typed a third time, nothing is left to do; with other settings, nothing is overwritten
    assert run_command("onboard", HOME, typed) == 0
    assert all(event["done"] for event in told(capsys) if event["event"] == "stage")
    assert run_command("onboard", HOME, [*typed, "seed=1"]) == 2
    assert "'render' was begun with other settings (seed)" in capsys.readouterr().err

    # the weights know the symmetries that were found
    from posefilter import load

    (method,) = load(out / "brick.ckpt").methods
    object_model = method.object_model
    assert method.calibration.counts["absent"] == 3
    assert method.calibration.counts["right"] + method.calibration.counts["wrong"] == 3
    assert object_model.name == "brick"
    assert len(object_model.symmetries) == 8
