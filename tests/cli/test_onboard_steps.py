"""The number of steps of an onboarding fills the time that there is, whatever was measured; what is
left is the time of the stages that are not done.
"""

import json
import shlex
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace

import pytest
from omegaconf import DictConfig, OmegaConf

from posefilter.cli import calibrate as calibration
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
    assert 600.0 / steps <= max(0.4, 600.0 / 20000)


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


def test_the_time_of_measuring_and_of_building_is_not_given_to_the_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"frames": 400, "test_frames": 60, "steps": None, "budget_minutes": 30}
    cfg = OmegaConf.create({**settings, "console": "json"})
    work = Onboarding(cfg, build(names()[0]), tmp_path, Stages(tmp_path / "record.json"))
    speed, now, run = Speed(step=0.3, image=1.0), [0.0], SimpleNamespace(callbacks=[])

    def measure(job: object) -> Speed:
        now[0] += 70
        return speed

    def build_run(work: Onboarding) -> SimpleNamespace:
        now[0] += 20
        return SimpleNamespace(trainer=run)

    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    monkeypatch.setattr(command, "measure_speed", measure)
    monkeypatch.setattr(command, "fit", lambda run: {})
    monkeypatch.setattr(Onboarding, "job", lambda *_: None)
    building = cached_property(build_run)
    building.__set_name__(Onboarding, "run")
    monkeypatch.setattr(Onboarding, "run", building)
    monkeypatch.setattr(Onboarding, "is_done", lambda *_: True)
    command.train(work)
    values = work.stages.values
    assert values["steps"] * values["seconds_per_step"] == pytest.approx(30 * 60 - 70)
    (budget,) = run.callbacks
    assert budget.seconds == pytest.approx(30 * 60 - 70 - 20)
    assert budget.fewest == 100  # which docs/onboard.md promises, however slow the machine is


@pytest.fixture
def rendering(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Have a frame take half a second, a step 1 s and an image 0.5 s; return the clock [s]."""
    now = [0.0]

    def render_scenes(job: SimpleNamespace) -> None:
        for i in range(command.count_frames(tmp_path / "data"), job.cfg.data.frames):
            file = tmp_path / "data" / "mixed" / "scene0_0" / f"{i:06d}.left.json"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.touch()
            now[0] += 0.5

    def make_job(work: Onboarding, folder: Path, frames: int | None = None) -> SimpleNamespace:
        data = OmegaConf.create({"frames": frames or work.frames})
        return SimpleNamespace(cfg=SimpleNamespace(data=data), folder=folder)

    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    monkeypatch.setattr(command, "render_scenes", render_scenes)
    monkeypatch.setattr(command, "measure_speed", lambda job: Speed(step=1.0, image=0.5))
    monkeypatch.setattr(Onboarding, "job", make_job)
    return now


def start(folder: Path, budget: float, **more: object) -> Onboarding:
    """Return an onboarding whose first two stages are done."""
    settings = {"frames": None, "test_frames": 60, "steps": None, "console": "rich", **more}
    settings["symmetries"] = "none"
    cfg = OmegaConf.create({**settings, "budget_minutes": budget})
    work = Onboarding(cfg, build(names()[0]), folder, Stages(folder / "record.json"))
    for stage in STAGES[:2]:
        work.stages.run(stage.name, work.settings_of(stage), lambda: None)
    return work


# 350 frames of 0.5 s, 100 steps of 1 s, 350 images of the calibration and 68 of the tests of 0.5 s,
# and 25 s for the rest: 509 s
@pytest.mark.parametrize(("budget", "more"), [(3.5, {}), (8.4, {"frames": 350})])
def test_a_budget_that_does_not_hold_the_least_is_told_early(
    budget: float,
    more: dict[str, object],
    tmp_path: Path,
    rendering: list[float],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    seen = []

    def measure(job: object) -> Speed:
        seen.append(command.count_frames(tmp_path / "data"))
        return Speed(step=1.0, image=0.5)

    monkeypatch.setattr(command, "measure_speed", measure)
    command.render(start(tmp_path, budget, **more))
    assert seen == [200]  # before the others are rendered
    (said,) = [one for one in capsys.readouterr().out.splitlines() if one.startswith("warning")]
    assert f"budget_minutes={budget:g} is too short on this machine" in said
    assert "take about 8 min 29 s" in said
    assert said.endswith("budget_minutes=8.5 frames=350")


@pytest.mark.parametrize(("budget", "more"), [(8.5, {"frames": 350}), (3.5, {"steps": 2000})])
def test_a_budget_that_holds_the_least_is_not_told_of(
    budget: float,
    more: dict[str, object],
    tmp_path: Path,
    rendering: list[float],
    capsys: pytest.CaptureFixture[str],
) -> None:
    work = start(tmp_path, budget, **more)
    command.render(work)
    assert "warning" not in capsys.readouterr().out
    assert work.speed == Speed(step=1.0, image=0.5)


def test_what_is_left_of_a_rendering_that_was_interrupted_is_known(
    tmp_path: Path, rendering: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    work = start(tmp_path, 3.5)
    assert work.seconds_left == 3.5 * 60  # of the budget
    stage = next(one for one in STAGES if one.name == "render")

    def interrupt(job: object) -> Speed:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(command, "measure_speed", interrupt)
        with pytest.raises(KeyboardInterrupt):
            work.stages.run(stage.name, work.settings_of(stage), lambda: stage.do(work))
    assert work.seconds_left == 3.5 * 60 - 200 * 0.5
    monkeypatch.setattr(command, "render_scenes", lambda _: None)  # interrupted before it goes on
    command.render(work)
    work.stages.keep(seconds_per_frame=0.5)
    # 150 frames, the fewest steps, and what follows
    assert work.seconds_left == 150 * 0.5 + 100 + (350 + 68) * 0.5 + 25
    work.cfg.train_overrides = ["filter.particles=500"]  # which may be slower
    assert work.speed is None


def test_a_training_that_ended_by_its_time_leaves_what_follows(
    tmp_path: Path, rendering: list[float]
) -> None:
    work = start(tmp_path, 8.5, frames=350)
    command.render(work)
    work.stages.keep(steps=5000)
    assert work.speed is not None
    left = work.seconds_left
    stage = next(one for one in STAGES if one.name == "train")
    work.stages.run(stage.name, work.settings_of(stage), lambda: None)
    assert work.seconds_left == work.rest(work.speed)
    assert left == 5000 * work.speed.step + work.rest(work.speed) + 8 * work.speed.image


@pytest.mark.parametrize("console", ["rich", "json"])
def test_a_calibration_tells_how_far_it_is_where_no_bar_is_seen(
    console: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    for _ in calibration._report_progress(range(10), 10, console):
        now[0] += 20.0
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 4  # every 40 s of 180
    first = {"event": "estimating", "batch": 2, "batches": 10}
    told = "estimating: batch 2 of 10, 2 min 40 s left of this pass"
    assert said[0] == (told if console == "rich" else json.dumps(first))


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
        ("data.generate.frames=3000", "data.generate.frames is frames= of this command"),
        ("data.limit_test=20", "data.limit_test is test_frames= of this command"),
        ("filter.partcles=20", "filter.partcles: there is no such setting"),
        ("filter.partcles=${filter.steps}", "filter.partcles: there is no such setting"),
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


def test_symmetries_of_a_folder_with_a_space_are_advised_as_they_are_typed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "my objects" / "symmetries.json"
    monkeypatch.setattr(command, "find_and_draw", lambda *given: "no symmetries")
    monkeypatch.setattr(command, "find_declared", lambda *given: (file, 2))
    cfg = OmegaConf.create(
        {"mesh": "a.obj", "mesh_scale": None, "symmetries": "auto", "console": "plain"}
    )
    work = Onboarding(cfg, build(names()[0]), tmp_path, Stages(tmp_path / "record.json"))
    command.use_symmetries(work)
    words = shlex.split(capfd.readouterr().out.partition("declares 2: ")[2].replace(")", ""))
    assert words[0] == f"symmetries={file}"


def test_a_training_that_was_refused_before_it_began_may_have_other_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The renders are kept; once there is a checkpoint, other settings would spoil it."""
    typed = ["mesh=banana", f"out={tmp_path / 'out'}", "console=json"]
    rendered = []

    def refuse(work: Onboarding) -> None:
        if work.cfg.train_overrides:
            raise UserError("refused here")
        checkpoints = work.training / "checkpoints"
        checkpoints.mkdir(parents=True)
        (checkpoints / "last.ckpt").touch()
        raise UserError("interrupted here")

    quick = {"mesh": command.store_meshes, "symmetries": command.use_symmetries, "train": refuse}
    quick["render"] = lambda work: rendered.append(work.frames)
    stages = [stage._replace(do=quick.get(stage.name, lambda work: None)) for stage in STAGES]
    monkeypatch.setattr(command, "STAGES", stages)
    said = []
    for more in (["filter.particles=20"], [], ["filter.particles=30"]):
        assert run_command("onboard", arguments=[*typed, f"train_overrides={more}"]) == 2
        said.append(capfd.readouterr().err.splitlines()[-1])
    assert said[0].endswith("refused here")
    assert said[1].endswith("interrupted here")
    assert "'train' was begun with other settings (train_overrides)" in said[2]
    assert len(rendered) == 1


def test_the_users_own_files_are_not_overwritten(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "meshes" / "banana").mkdir(parents=True)
    own = tmp_path / "meshes" / "banana" / "symmetries.json"
    own.write_text("{}")
    assert run_command("onboard", arguments=["mesh=banana", f"out={tmp_path}"]) == 2
    assert "meshes: is no onboarding's, and would be" in capfd.readouterr().err
    Stages(tmp_path / "onboarding.json").keep()  # now it is
    given = ["mesh=banana", f"out={tmp_path}", f"symmetries={own}"]
    assert run_command("onboard", arguments=given) == 2
    assert "is written by this command" in capfd.readouterr().err
    assert own.read_text() == "{}"


def test_what_is_told_at_the_end_is_of_its_own_test(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """A user may have evaluated in the training's folder since."""
    training = tmp_path / "training"
    training.mkdir()
    scores = {"add": {}, "add_s": {}, "mssd": {}, "mspd": {}}
    own = {**scores, "add": {"auc": 93.0}}
    other = {**scores, "add": {"auc": 5.0}, "command": "evaluate"}
    (training / "metrics_train.json").write_text(json.dumps(own))
    (training / "metrics.json").write_text(json.dumps(other))
    cfg = OmegaConf.create({"console": "json"})
    work = Onboarding(cfg, build("banana"), tmp_path, Stages(tmp_path / "record.json"))
    command.tell(work)
    assert json.loads(capfd.readouterr().out.splitlines()[-1])["add"] == {"auc": 93.0}


def test_a_folder_may_have_any_name(tmp_path: Path) -> None:
    out = tmp_path / "Mike's drill, new=1"
    cfg = OmegaConf.load(find_conf() / "onboard.yaml")
    assert isinstance(cfg, DictConfig)
    cfg.warm_start = "Mike's.ckpt"
    cfg.train_overrides = ["filter.initial_particles=${filter.particles}"]  # of the training's
    mesh = build("brick")
    training = Onboarding(cfg, mesh, out, Stages(out / "onboarding.json", {})).job(out / "training")
    assert training.cfg.data.root == str(out / "data")
    assert training.cfg.data.meshes == str(out / "meshes")
    assert training.cfg.warm_start == "Mike's.ckpt"
    assert training.cfg.filter.initial_particles == training.cfg.filter.particles
