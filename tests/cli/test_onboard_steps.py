"""The number of steps of an onboarding fills the time that there is, whatever was measured; what is
left is the time of the stages that are not done.
"""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from omegaconf import DictConfig, OmegaConf

from posefilter.cli import onboard as command
from posefilter.cli import run_command
from posefilter.cli.measure_speed import Speed
from posefilter.cli.onboard import STAGES, Onboarding, choose_steps
from posefilter.cli.stages import Stages
from posefilter.errors import UserError
from posefilter.meshes.builtin.catalog import build, names
from posefilter.paths import find_conf


@pytest.mark.parametrize("step", [0.05, 0.3, 0.4, 4.0])
def test_all_of_the_time_is_used(step: float) -> None:
    steps, seconds = choose_steps(600.0, step)
    assert steps * seconds == pytest.approx(600.0)
    # of a machine that was busy while it was measured, most of the time would be left unused
    assert 600.0 / steps <= max(0.4, 600.0 / 8000)


def test_a_slow_measure_does_not_shorten_the_training() -> None:
    assert choose_steps(600.0, 4.0) == choose_steps(600.0, 0.4)


def test_some_steps_are_taken_even_if_no_time_is_left() -> None:
    assert choose_steps(-5.0, 0.5) == (100, 0.5)


def test_what_is_left_is_the_time_of_the_stages_that_are_not_done(tmp_path: Path) -> None:
    cfg = OmegaConf.create({"frames": 400, "test_frames": 60, "symmetries": "none"})
    work = Onboarding(cfg, build(names()[0]), tmp_path, Stages(tmp_path / "record.json"))
    speed = Speed(step=0.5, image=1.0)
    left = []
    for stage in STAGES:
        left.append(work.rest(speed))
        work.stages.run(stage.name, work.settings_of(stage), lambda: None)
    found = dict(zip([stage.name for stage in STAGES], left, strict=True))
    # 400 images of the calibration, 60 of the test, 8 of the training, and 25 s for all else
    assert found["mesh"] == found["train"] == 400 + 60 + 8 + 25
    assert found["export"] == found["calibrate"] == 400 + 60 + 25
    assert found["test"] == 60 + 25
    assert found["report"] == 25
    assert work.rest(speed) == 0
    cfg.test_frames = 30  # the test is to be made again
    assert work.rest(speed) == 30 + 25
    cfg.test_frames = 500  # of 120 that are rendered
    assert work.rest(speed) == 120 + 25


def test_the_time_of_measuring_is_not_given_to_the_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"frames": 400, "test_frames": 60, "steps": None, "budget_minutes": 30}
    cfg = OmegaConf.create({**settings, "console": "json"})
    work = Onboarding(cfg, build(names()[0]), tmp_path, Stages(tmp_path / "record.json"))
    speed, now, run = Speed(step=0.3, image=1.0), [0.0], SimpleNamespace(callbacks=[])

    def measure(job: object) -> Speed:
        now[0] += 70
        return speed

    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    monkeypatch.setattr(command, "measure_speed", measure)
    monkeypatch.setattr(command, "fit", lambda run: {})
    monkeypatch.setattr(Onboarding, "job", lambda *_: None)
    monkeypatch.setattr(Onboarding, "run", SimpleNamespace(trainer=run))
    monkeypatch.setattr(Onboarding, "is_done", lambda *_: True)
    command.train(work)
    values = work.stages.values
    assert values["steps"] * values["seconds_per_step"] == pytest.approx(30 * 60 - 70)
    assert len(run.callbacks) == 1  # which keeps to it


def test_another_texture_mapping_is_another_mesh(tmp_path: Path) -> None:
    cfg = OmegaConf.create({"frames": 400})
    mesh = build("carton")
    assert mesh.corner_uv is not None
    flipped = replace(mesh, corner_uv=mesh.corner_uv * [1, -1] + [0, 1])
    works = [
        Onboarding(cfg, one, tmp_path, Stages(tmp_path / "record.json"))
        for one in (mesh, replace(mesh), flipped)
    ]
    same, again, other = (work.mesh_digest for work in works)
    assert same == again != other


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("filter/resample=below_ess", "is now filter/resample=adaptive"),
        ("trainer.max_steps=300", "steps= sets the number"),
        ("+trainer.val_check_interval=5", "trainer.val_check_interval follows from"),
        ("filter.partcles=20", "filter.partcles: there is no such setting"),
    ],
)
def test_mistakes_in_overrides_are_told_before_anything_is_written(
    override: str, told: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    typed = ["mesh=banana", f"train_overrides=['{override}']", f"out={tmp_path / 'out'}"]
    assert run_command("onboard", arguments=typed) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert told in line
    assert not (tmp_path / "out").exists()


def test_other_symmetries_are_refused_before_they_replace_those_of_the_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    typed = ["mesh=banana", f"out={tmp_path / 'out'}", "console=json"]

    def stop(work: Onboarding) -> None:
        raise UserError("stopped here")

    quick = {"mesh": command.store_meshes, "symmetries": command.use_symmetries}
    stages = [stage._replace(do=quick.get(stage.name, lambda work: None)) for stage in STAGES]
    stages = [stage._replace(do=stop) if stage.name == "export" else stage for stage in stages]
    monkeypatch.setattr(command, "STAGES", stages)
    assert run_command("onboard", arguments=typed) == 2
    file = tmp_path / "out" / "meshes" / "banana" / "symmetries.json"
    before = file.read_text()
    assert run_command("onboard", arguments=[*typed, "symmetries=none"]) == 2
    assert "'symmetries' was begun with other settings" in capfd.readouterr().err
    assert file.read_text() == before
    assert run_command("onboard", arguments=typed) == 2
    assert capfd.readouterr().err.splitlines()[-1].endswith("stopped here")


def test_a_folder_may_have_any_name(tmp_path: Path) -> None:
    out = tmp_path / "Mike's drill, new=1"
    cfg = OmegaConf.load(find_conf() / "onboard.yaml")
    assert isinstance(cfg, DictConfig)
    cfg.warm_start = "Mike's.ckpt"
    mesh = build("brick")
    training = Onboarding(cfg, mesh, out, Stages(out / "onboarding.json", {})).job(out / "training")
    assert training.cfg.data.root == str(out / "data")
    assert training.cfg.data.meshes == str(out / "meshes")
    assert training.cfg.warm_start == "Mike's.ckpt"
