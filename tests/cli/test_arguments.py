"""What is typed reaches each job of a sweep over choices."""

from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from posefilter.cli import run_command
from posefilter.cli.arguments import (
    bracketed,
    defer_settings,
    maximized,
    name_places,
    options_first,
    quoted,
    told_apart,
    with_home,
)
from posefilter.cli.build import make_trainer
from posefilter.cli.choices import check_added, check_choices
from posefilter.cli.command import compose_config
from posefilter.cli.explain import near
from posefilter.cli.job import Job, check_settings
from posefilter.cli.preflight import check_files
from posefilter.errors import MISTAKE, UserError

HOME = Path(__file__).parents[2]


@pytest.mark.parametrize("more", [[], ["sweep=ablation_detect", "ablation=paper,working"]])
@pytest.mark.slow
def test_a_setting_that_only_the_swept_choices_have_reaches_each_job(
    more: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    widths = []

    def record(job: Job) -> float:
        widths.append((job.choices["model"], job.cfg.model.net.width))
        return 0.0

    monkeypatch.setattr("posefilter.cli.train.train", record)
    typed = ["-m", "model=cnn_patch,downsized", "model.net.width=16", f"out={tmp_path}"]
    assert run_command("train", HOME, [*typed, "console=json", *more]) == 0
    assert sorted({*widths}) == [("cnn_patch", 16), ("downsized", 16)]
    assert len(widths) == (4 if more else 2)


def test_a_setting_that_no_job_has_is_refused_with_the_nearest(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    typed = ["-m", "model=cnn_patch,downsized", "model.net.widht=16", f"out={tmp_path}"]
    assert run_command("train", HOME, typed) == 2
    assert "model.net.widht: there is no such setting" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("typed", "told"),
    [
        ("particles=50", "particles: there is no such setting; did you mean 'filter.particles' or"),
        ("filter.lr=1", "filter.lr: there is no such setting; did you mean 'optimizer.lr'?"),
        ("filter.particel=5", "there is no such setting; did you mean 'filter.particles'?"),
    ],
)
def test_a_setting_in_the_wrong_place_is_told_its_place(
    typed: str, told: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run_command("train", HOME, [typed]) == 2
    assert told in capfd.readouterr().err


@pytest.mark.parametrize(
    ("command", "typed", "told"),
    [
        ("train", "ckpt_path=a/last.ckpt", "type resume=RUN to go on with a run, or warm_start="),
        ("evaluate", "ckpt_path=a/best.ckpt", "type checkpoint=RUN"),
        ("train", "train=False", "a checkpoint is tested by evaluate"),
        ("train", "test=False", "a training ends with a test of its best checkpoint"),
        ("train", "hparams_search=mnist_optuna", "type -m hydra/sweeper=optuna"),
    ],
)
def test_a_setting_of_others_programs_is_told_what_is_typed_here(
    command: str, typed: str, told: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run_command(command, HOME, [typed]) == 2
    key = typed.partition("=")[0]
    assert f"{command}: {key}: there is no such setting; {told}" in capfd.readouterr().err


@pytest.mark.parametrize("sign", ["", "+"])
@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ("enable_progress_bar=false", "console=json shows no bar"),
        ("callbacks=x", "type +callbacks.NAME._target_=CLASS"),
        ("logger=x", "type logger=NAME"),
        ("plugins=x", "leave it out"),
    ],
)
def test_what_a_trainer_is_given_is_told_what_is_typed_for_it(
    sign: str, setting: str, told: str, capfd: pytest.CaptureFixture[str]
) -> None:
    typed = f"trainer.{setting}"
    if sign:
        settings = OmegaConf.from_dotlist([typed, "trainer._target_=lightning.Trainer"])
        with pytest.raises(UserError) as refusal:
            make_trainer(settings.trainer, [])
        said = str(refusal.value)
    else:
        assert run_command("train", HOME, [typed]) == 2
        said = capfd.readouterr().err
    key = typed.partition("=")[0]
    assert f"{key}: is not a setting; the program gives it itself; {told}" in said


def test_of_many_settings_of_one_name_those_are_told_that_are_typed_alike() -> None:
    known = ["data.width", "model.encoder.width", "model.pose_head.width", "model.net.width"]
    told = "; did you mean 'model.net.width' or 'model.encoder.width'?"
    assert near("modle.net.width", known) == told


@pytest.mark.parametrize(
    ("typed", "told"),
    [
        ("tracker={rounds: 2}", "tracker.rounds: is now tracker.quadratic_fits"),
        ("tracker.motion={momentum: 1}", "tracker.motion.momentum: is now tracker.motion.vel"),
        ("tracker={patiense: 2}", "tracker.patiense: there is no such setting; did you mean"),
    ],
)
def test_a_wrong_key_within_a_mapping_is_named(
    typed: str, told: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run_command("track", HOME, ["checkpoint=003_cracker_box", typed]) == 2
    assert told in capfd.readouterr().err


def test_a_sweep_over_numbers_is_left_as_typed() -> None:
    typed = ["-m", "filter.particles=50,100", "model.net.width=16", "model=patch_pf"]
    assert defer_settings(typed, HOME / "conf") == typed
    assert defer_settings(typed[3:] + typed[2:3], HOME / "conf") == ["model=patch_pf", typed[2]]


@pytest.mark.parametrize(
    ("typed", "value"),
    [
        ("out=a/b,c=1", None),  # a sweep over two values, each of them quoted
        (r"out=a/seed\=0\,model\=x_160\,/y.ckpt", "a/seed=0,model=x_160,/y.ckpt"),
        ("out='a/seed=0,b'", "a/seed=0,b"),
        ("out=a/ü=1", "a/ü=1"),
    ],
)
def test_a_folder_named_after_settings_can_be_typed(typed: str, value: str | None) -> None:
    parsed = OverridesParser.create().parse_override(quoted([typed])[0])
    if value is None:
        assert [str(part) for part in parsed.sweep_string_iterator()] == ["'a/b'", "'c=1'"]
    else:
        assert parsed.value() == value


@pytest.mark.parametrize(
    ("typed", "passed"),
    [
        ("intrinsics=1,2,3,4", "intrinsics=[1,2,3,4]"),
        ("size=320,240", "size=[320,240]"),
        ("data.generate.size=320,240", "data.generate.size=[320,240]"),
        ("model.glimpse.size=3,6", "model.glimpse.size=3,6"),  # a sweep over one number
        ("size=[320,240],[640,480]", "size=[320,240],[640,480]"),
    ],
)
def test_lists_of_numbers_need_no_brackets(typed: str, passed: str) -> None:
    assert bracketed([typed]) == [passed]


@pytest.mark.parametrize("command", ["evaluate", "predict", "report", "export"])
def test_every_command_shows_where_a_mistake_came_from(
    command: str, capfd: pytest.CaptureFixture[str]
) -> None:
    wrong = {"report": "run=nowhere", "predict": "rgb=a"}.get(command, "checkpoint=nowhere.ckpt")
    assert run_command(command, HOME, [wrong, "debug=traceback"]) == 2
    said = capfd.readouterr().err
    assert "Traceback" in said
    assert said.splitlines()[-1].startswith(f"{command}: ")
    assert "debug" not in said.splitlines()[-1]
    assert run_command(command, HOME, [wrong, "debug=smoke"]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert (
        line
        == f"{command}: debug=smoke: only valid for train; {command} accepts only debug=traceback"
    )


@pytest.mark.parametrize(
    ("command", "typed"),
    [
        ("train", "data.root=A,B"),
        ("train", "threads=1,2"),
        ("evaluate", "checkpoint=A,B"),
        ("evaluate", "data=fat,ycb_video"),
    ],
)
@pytest.mark.slow
def test_a_sweep_gives_each_job_a_folder_of_its_own(
    command: str, typed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = []
    monkeypatch.setattr(f"posefilter.cli.{command}.{command}", lambda job: folders.append(job))
    monkeypatch.setattr("posefilter.cli.running.check_files", lambda name, cfg: None)
    words = ["-m", typed, f"out={tmp_path}", "console=json"]
    assert run_command(command, HOME, [*words, "plugins=[]"]) == 0
    key, _, values = typed.partition("=")
    assert [job.folder.name for job in folders] == [f"{key}={one}" for one in values.split(",")]


def test_folders_are_not_named_after_what_is_not_swept() -> None:
    for typed in (["-m", "data.root=A", "seed=1,2"], ["data.root=A"], ["seed=1"]):
        assert told_apart(typed, "train", HOME / "conf") == typed


@pytest.mark.parametrize(
    ("command", "typed", "told"),
    [
        (
            "export",
            ["checkpoint=003_cracker_box", "format=onnx", "out=x"],
            "format=onnx: the package o",
        ),
        ("generate", ["settle=true"], "settle=true: the package mujoco"),
        ("generate", ["renderer=opengl"], "renderer=opengl: the package moderngl"),
        ("generate", [], ""),
    ],
)
def test_a_package_that_is_missing_is_named_at_once(
    command: str, typed: list[str], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("posefilter.cli.preflight.find_spec", lambda name: None)
    cfg = compose_config(command, typed)
    if told:
        with pytest.raises(UserError, match=told):
            check_files(command, cfg)
    else:
        check_files(command, cfg)


def test_options_may_stand_anywhere() -> None:
    typed = ["seed=1", "--config-dir", "mine", "loss=bce", "-m", "--cfg", "job", "x=2", "-cd"]
    ordered = ["--config-dir", "mine", "-m", "--cfg", "job", "-cd", "seed=1", "loss=bce", "x=2"]
    assert options_first(typed) == ordered


@pytest.mark.parametrize(
    ("typed", "ordered"),
    [
        (["--info", "seed=1"], ["--info", "all", "seed=1"]),
        (["seed=1", "-i", "plugins"], ["-i", "plugins", "seed=1"]),
        (["seed=1", "--info"], ["--info", "all", "seed=1"]),
        (["a=1", "-i", "-cd", "D", "b=2"], ["-i", "all", "-cd", "D", "a=1", "b=2"]),
    ],
)
def test_an_option_whose_value_is_left_out_takes_no_setting(
    typed: list[str], ordered: list[str]
) -> None:
    assert options_first(typed) == ordered


@pytest.mark.parametrize("typed", [["-cn", "predict"], ["--config-name=predict"]])
def test_the_settings_of_another_command_are_refused(
    typed: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    assert run_command("train", HOME, typed) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(
        "train: --config-name=predict: is not train's, but has the settings of predict"
    )


def test_a_trainers_choices_are_those_of_a_training(capfd: pytest.CaptureFixture[str]) -> None:
    """evaluate's has no steps."""
    assert run_command("train", HOME, ["trainer=cpu"]) == 2
    told = "trainer=cpu: there is no such choice; there are default; one of your own needs "
    assert f"{told}plugins=[PACKAGE] or --config-dir DIR" in capfd.readouterr().err


def test_settings_of_ones_own_that_choose_no_method_are_told_what_is_missing() -> None:
    with pytest.raises(UserError, match=r"model: nothing .* to the defaults in your own file"):
        check_settings(OmegaConf.create({"seed": 0}), "train", {})


@pytest.mark.parametrize("option", ["--experimental-rerun", "--exp"])
def test_hydras_own_way_to_run_again_is_refused(option: str) -> None:
    told = r"^--experimental-rerun: .* type resume=RUN to go on with a run$"
    for typed in ([option, "run/.hydra/job.pickle"], [f"{option}=run/.hydra/job.pickle"]):
        with pytest.raises(UserError, match=told):
            options_first(typed)


def test_a_search_maximizes_unless_told_otherwise() -> None:
    search, direction = ["-m", "hydra/sweeper=optuna"], "hydra.sweeper.direction="
    assert maximized(search) == [*search, f"{direction}maximize"]
    for typed in (["-m"], [*search, f"{direction}minimize"], [*search, f"+{direction}minimize"]):
        assert maximized(typed) == typed


def test_a_path_with_commas_that_is_there_is_one_value(tmp_path: Path) -> None:
    path = tmp_path / "loss=bce,seed=1"
    parse = OverridesParser.create().parse_override
    assert parse(quoted([f"resume={path}"])[0]).is_sweep_override()
    path.mkdir()
    assert parse(quoted([f"resume={path}"])[0]).value() == str(path)


@pytest.mark.parametrize(
    ("typed", "built"),
    [
        ("logger=[csv,tensorboard]", ["csv", "tensorboard"]),
        ("logger=csv", ["csv"]),
        ("logger=none", []),
    ],
)
def test_several_loggers_can_be_chosen(
    typed: str, built: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs: list[Job] = []
    monkeypatch.setattr("posefilter.cli.train.train", jobs.append)
    assert run_command("train", HOME, [typed, f"out={tmp_path / 'run'}", "console=json"]) == 0
    assert list(jobs[0].cfg.logger) == built


@pytest.mark.parametrize("typed", ["logger=[]", "loss=[bce]", "logger={a: b}"])
def test_other_groups_take_one_choice(
    typed: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run_command("train", HOME, [typed, f"out={tmp_path / 'run'}"]) == 2
    assert "takes the name of a choice, not a value" in capfd.readouterr().err


def test_no_logger_can_be_typed_as_a_deletion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs: list[Job] = []
    monkeypatch.setattr("posefilter.cli.train.train", jobs.append)
    assert run_command("train", HOME, ["~logger", f"out={tmp_path / 'run'}", "console=json"]) == 0
    assert not jobs[0].cfg.logger


def test_an_unknown_choice_of_several_is_named(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run_command("train", HOME, ["logger=[csv,tensorbord]", f"out={tmp_path / 'run'}"]) == 2
    assert "no choice 'tensorbord'; did you mean 'tensorboard'" in capfd.readouterr().err


def test_a_long_odd_value_is_no_path() -> None:
    assert quoted([f"rgb={'ü' * 300}"]) == [f"rgb='{'ü' * 300}'"]


def test_a_sweep_of_a_list_tells_its_jobs_apart_too() -> None:
    typed = ["sweep=seeds", "data.root=A,B"]
    (named,) = told_apart(typed, "train", HOME / "conf")[2:]
    assert "data.root" not in named
    assert "exclude_keys=[out,resume," in named


@pytest.mark.parametrize(
    ("typed", "passed"),
    [
        ("out=~/runs/a", "out=/home/u/runs/a"),
        ("'rgb=~/a b.png'".strip("'"), "rgb=/home/u/a b.png"),
        ("checkpoint=[~/a.ckpt,~/b.ckpt]", "checkpoint=[/home/u/a.ckpt,/home/u/b.ckpt]"),
        ("data.root=~/a,~/b", "data.root=/home/u/a,/home/u/b"),
        ("out='~/c d'", "out='/home/u/c d'"),
        ("~logger", "~logger"),
        ("out=a~/b", "out=a~/b"),
        ("name=~x", "name=~x"),
        ("--config-dir=~/c", "--config-dir=~/c"),  # the shell's own
    ],
)
def test_the_home_folder_is_written_out(
    monkeypatch: pytest.MonkeyPatch, typed: str, passed: str
) -> None:
    monkeypatch.setenv("HOME", "/home/u")
    assert with_home([typed]) == [passed]


def test_without_a_home_folder_only_what_needs_it_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def missing() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", missing)
    assert with_home(["out=a", "~logger"]) == ["out=a", "~logger"]
    with pytest.raises(UserError, match="no home folder is known"):
        with_home(["out=~/a"])


def test_bags_at_home_are_places() -> None:
    typed = ["~/in.bag", "~/out.bag", "~logger"]
    assert name_places(typed) == ["bag=~/in.bag", "out=~/out.bag", "~logger"]


@pytest.mark.parametrize("option", ["--cfg job", "-c hydra", "--config-dir own", "--info defaults"])
def test_the_value_of_an_option_is_no_bag(option: str) -> None:
    words = option.split()
    assert name_places([*words, "in.bag", "out.bag"]) == [*words, "bag=in.bag", "out=out.bag"]
    assert name_places(["in.bag", *words]) == ["bag=in.bag", *words]


def test_a_choice_that_is_typed_as_a_setting_is_told_by_todays_name() -> None:
    with pytest.raises(UserError, match=r"type filter/resample=adaptive$"):
        check_choices(["filter.resample=below_ess"], HOME / "conf")


def test_a_setting_that_nothing_reads_cannot_be_added() -> None:
    conf = HOME / "conf"
    with pytest.raises(UserError, match=r"\+sed: nothing reads .* without \+"):
        check_added(["+sed=1"], conf, "train")
    with pytest.raises(UserError, match=r"\+foo: nothing reads"):
        check_added(["debug=smoke", "++foo=1"], conf, "train")
    with pytest.raises(UserError, match=r"\+foo: nothing reads"):
        compose_config("train", ["+foo=1"])
    with pytest.raises(UserError, match=r"\+fliter.particles: nothing reads"):
        check_added(["++fliter.particles=9"], conf, "train")
    for taken in ("+experiment=memorize", "++seed=1", "+filter.own=1", "+plugins=[own]"):
        check_added([taken], conf, "train")


def test_a_setting_that_an_interpolation_reads_can_be_added(tmp_path: Path) -> None:
    conf = HOME / "conf"
    # of conf/loss/aux/displacement, where that is chosen
    check_added(["-m", "model=pose_pf,patch_pf", "++margin_px=3"], conf, "train")
    check_added(["-m", "+n=50,100", "filter.particles=${n}"], conf, "train")
    check_added(["+n=9"], conf, "train", ["filter.steps=${n}", "+n=9"])  # of a resumed run
    (tmp_path / "loss").mkdir()
    (tmp_path / "loss" / "own.yaml").write_text("width: ${own_width}\n")
    check_added(["--config-dir", str(tmp_path), "+own_width=3"], conf, "train")


def test_a_run_goes_on_that_was_begun_with_a_setting_that_nothing_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = tmp_path / ".hydra" / "overrides.yaml"
    for file in (record, tmp_path / "checkpoints" / "last.ckpt"):
        file.parent.mkdir()
        file.write_text("[+note=first, trainer.max_steps=0]")
    assert run_command("train", HOME, [f"resume={tmp_path}"]) == MISTAKE
    assert "trainer.max_steps" in capsys.readouterr().err  # and not of the note


@pytest.mark.parametrize("name", ["1.10", "2024_05_02", "1e5", "007", "1.", ".5"])
@pytest.mark.parametrize("key", ["out", "data.root", "+rgb", "generate.meshes"])
def test_a_folder_that_is_named_by_a_number_is_taken_as_it_is_typed(key: str, name: str) -> None:
    """As a number 1.10 would be 1.1: another folder, whose results would be replaced."""
    (parsed,) = OverridesParser.create().parse_overrides(quoted([f"{key}={name}"]))
    assert parsed.value() == name


def test_frames_are_a_folder_of_track_and_a_number_elsewhere() -> None:
    assert quoted(["frames=2024_06_01"], "track") == ["frames='2024_06_01'"]
    assert quoted(["frames=12"], "onboard") == ["frames=12"]


def test_numbers_of_other_settings_stay_numbers() -> None:
    typed = [
        "seed=3",
        "frames=12",
        "model.net.depth=3",
        "optimizer.lr=1e-3",
        "out=null",
        "checkpoint=a.ckpt",
        "seed=1,2",
    ]
    assert quoted(typed) == typed


@pytest.mark.parametrize("typed", ["intrinsics=(1,2,3,4)", "intrinsics=1,2,3,4,"])
def test_advice_for_lists_of_numbers_is_their_form(
    typed: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run_command("predict", HOME, ["rgb=a.png", "depth=b.png", typed]) == 2
    assert "it is typed intrinsics=fx,fy,cx,cy" in capfd.readouterr().err


@pytest.mark.parametrize(
    "name", ["IMG (1).png", "a,b.png", "[a].png", "it's.png", "a {b}.png", "a b"]
)
def test_a_file_that_is_there_needs_no_quotes(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).touch()
    (parsed,) = OverridesParser.create().parse_overrides(quoted([f"rgb={name}"]))
    assert parsed.value() == name
    assert quoted([f"seed={name}"]) == [f"seed={name}"]  # no setting that names a file


@pytest.mark.parametrize(
    "typed", [["--rgb", "a.png"], ["--rgb=a.png"], ["seed=1", "--rgb", "a.png"]]
)
def test_a_setting_typed_as_an_option_is_told_how_it_is_typed(typed: list[str]) -> None:
    with pytest.raises(UserError, match="--rgb: is no option; settings are typed rgb="):
        options_first(typed)
    assert options_first(["seed=1", "--multi"]) == ["--multi", "seed=1"]  # Hydra's, cut short


@pytest.mark.parametrize("typed", ["folder", "/path/to/run"])
def test_a_word_without_a_key_is_told_how_settings_are_typed(
    typed: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run_command("report", HOME, [typed]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert "settings are typed key=value, without blanks about =" in line
