"""Command lines that make no sense end in one line that names what is wrong, and leave nothing."""

import io
import json
import shlex
import shutil
from pathlib import Path

import pytest
import torch

from posefilter.cli import run_command
from posefilter.cli.build import make_trainer
from posefilter.cli.command import compose_job
from posefilter.cli.console import say
from posefilter.cli.explain import explain, explain_hydra
from posefilter.cli.folders import read_metrics
from posefilter.cli.instantiate import instantiate
from posefilter.errors import UserError

HOME = Path(__file__).parents[2]
LINES = {
    "an empty folder's name": ("train", ["out="], "out=: names no folder"),
    "a list as a folder": ("check_data", ["out=[a]"], "Cannot convert 'ListConfig' to string"),
    "a reference to nothing": ("train", ["out=${nope}"], "Interpolation key 'nope' not found"),
    "a folder in /proc": ("train", ["out=/proc/x"], "/proc/x: cannot be written"),
    "a file as a folder": ("evaluate", ["out=/dev/null/x", "checkpoint=x"], "/dev/null/x"),
    "a name that is too long": ("train", [f"out={'n' * 300}"], "File name too long"),
    "a number as a choice": ("train", ["loss/aux/likelihood=5"], "likelihood=5: cannot be read"),
    "a reference of another command": ("generate", ["out=${nope}"], "key 'nope' not found"),
    "a mapping as a checkpoint": ("export", ["checkpoint={}", "out=a.ckpt"], "a file, a run's"),
    "a number as a file": (
        "export",
        ["checkpoint=003_cracker_box", "out=0.5"],
        "out=0.5: must end in .ckpt",
    ),
    "a text that is made of a number": (
        "export",
        ["checkpoint=003_cracker_box", "out=a.ckpt", "points=${seed}.5"],
        "points=0.5: must be a whole number",
    ),
    "a part that is made of a number": (
        "track",
        ["checkpoint=003_cracker_box", "frames=.", "tracker.follow.pixels=${seed}"],
        "tracker.follow.pixels=0: must be a whole number",
    ),
    "a number as a copy": (
        "calibrate",
        ["checkpoint=003_cracker_box", "out=0.5"],
        "out=0.5: ",
    ),
    "a word for true": (
        "calibrate",
        ["checkpoint=003_cracker_box", "overwrite=no"],
        "overwrite=no: choose true or false",
    ),
    "a list as an optimizer": (
        "train",
        ["debug=smoke", "model.optimizer=[1,2]"],
        "model.optimizer=[1, 2]: must be what a _target_ builds",
    ),
    "a mapping as a loss": ("train", ["debug=smoke", "model.loss={a: 1}"], "must be a Loss"),
    "no interval, by a reference": (
        "train",
        ["debug=smoke", "trainer.val_check_interval=${seed}"],
        "trainer.val_check_interval=0: must be",
    ),
    "no number of steps": (
        "train",
        ["debug=smoke", "trainer.max_steps=null"],
        "trainer.max_steps: is",
    ),
    "no meshes": ("check_data", ["meshes=null", "data.root=."], "meshes: is missing"),
    "a number as a dataset": ("check_data", ["data.root=5"], "data.root=5: no such folder"),
    "true as a dataset": ("check_data", ["data.root=true"], "must be the name of a file or folder"),
    "meshes by their other name": (
        "check_data",
        ["data.meshes=nowhere", "data.root=."],
        "data.meshes=nowhere: no such folder",
    ),
    "no model": ("train", ["model=null"], "model=null: takes the name of a choice"),
    "no picture": ("predict", ["rgb=5", "depth=5", "intrinsics=1,1,1,1"], "rgb=5: no such file"),
    "an umlaut": (
        "train",
        ["data=fat", "data.root=/nope/\u00fc"],
        "data.root=/nope/\u00fc: no such",
    ),
    "weights that are not there": (
        "onboard",
        ["mesh=carton", "warm_start=/nope"],
        "warm_start=/nope: no such file",
    ),
    "one of several weights that is not there": (
        "train",
        ["warm_start=[003_cracker_box,nope]"],
        "warm_start=nope: no such file",
    ),
    "a number for settings": (
        "onboard",
        ["mesh=carton", "train_overrides=5"],
        "train_overrides=5: must be a list",
    ),
    "a mapping among settings": (
        "onboard",
        ["mesh=carton", "train_overrides=[{a: 1}]"],
        "must be a list, such as",
    ),
    "an equals sign": (
        "train",
        ["data=fat", "data.root=/nope/a=b"],
        "data.root=/nope/a=b: no such",
    ),
}


@pytest.mark.parametrize("case", LINES)
def test_it_is_one_line(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    command, typed, told = LINES[case]
    monkeypatch.chdir(tmp_path)
    if command == "predict":
        typed = [*typed, "checkpoint=003_cracker_box"]
    assert run_command(command, HOME, [*typed, "console=json"]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f"{command}: ")
    assert told in line
    assert [*tmp_path.iterdir()] == []


def test_what_a_library_refuses_is_one_line() -> None:
    node = {"_target_": "posefilter.cli.best.Best", "dirpath": "x", "monitor": "a", "mode": "/"}
    with pytest.raises(UserError, match=r"^callbacks.best: cannot be built \(`mode` can be min"):
        instantiate(node, "callbacks.best")


def test_what_the_program_gives_is_no_setting() -> None:
    node = {"_target_": "lightning.Trainer", "plugins": [1]}
    with pytest.raises(UserError, match=r"^trainer.plugins: is not a setting"):
        instantiate(node, "trainer", plugins=None)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    job = compose_job("train", HOME / "conf", ["trainer.accelerator=gpu"], tmp_path)
    job.cfg.folder = str(tmp_path)
    with pytest.raises(UserError, match=r"^trainer: cannot be built \(.*gpu") as caught:
        make_trainer(job.cfg.trainer, [])
    assert "\n" not in str(caught.value)


def test_damaged_metrics_are_one_line(tmp_path: Path) -> None:
    file = tmp_path / "metrics.json"
    for content in ("", "{", "[1]", "[" * 100_000, "\ud800".encode("utf-8", "surrogatepass")):
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
        with pytest.raises(UserError, match=r"metrics\.json: ") as caught:
            read_metrics(file)
        assert "\n" not in str(caught.value)
    file.write_text(json.dumps({"iou": 0.5}))
    assert read_metrics(file) == {"iou": 0.5}


def test_a_launcher_that_fails_is_named(tmp_path: Path) -> None:
    """And no other choice, nor a folder of one's own, is blamed, as it is where Hydra's own code
    fails.
    """
    folder = ["--config-dir", str(tmp_path)]
    typed = [*folder, "debug=smoke", "hydra/launcher=submitit_slurm", "seed=0,1"]
    for file, told in (
        ("/x/hydra_plugins/y.py", "hydra/launcher=submitit_slurm: has failed (no srun)"),
        ("/x/hydra/y.py", "debug=smoke: cannot be read (no srun)"),
    ):
        with pytest.raises(RuntimeError) as caught:
            exec(compile("raise RuntimeError('no srun\\nhere')", file, "exec"))
        assert explain_hydra(caught.value, HOME / "conf", typed) == told


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("raise ValueError('a\\nb')", "ValueError: a)"),
        ("import sys; sys.exit(0)", "SystemExit: 0)"),
        ("def (", "SyntaxError: "),
        ("def f(): f()\nf()", "RecursionError: "),
    ],
)
def test_a_plugin_that_cannot_be_imported_is_one_line(
    content: str,
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "broken_plugin.py").write_text(content)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("posefilter.cli.trust._trusted", set())
    typed = ["checkpoint=003_cracker_box", "out=a.ckpt", "plugins=[broken_plugin]"]
    assert run_command("export", HOME, typed) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f"export: plugins=broken_plugin: could not be imported ({told}")


@pytest.mark.parametrize("name", ["a,b", "x'y", "[z]", 'q"r', "$w'", "{q}", "~t"])
def test_a_name_that_hydra_cannot_read_is_told_as_it_is_typed(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    typed = ["checkpoint=003_cracker_box", "intrinsics=1,1,1,1", f"out={tmp_path / 'out'}"]
    argument = f"frames=/nope/{name}"
    if name != "~t":  # which is quoted for its user
        assert run_command("track", HOME, [*typed, argument]) == 2
        (line,) = capfd.readouterr().err.splitlines()
        assert line.startswith(f"track: {argument}: ")
        (argument,) = shlex.split(line.partition("as one text it is typed ")[2])
    assert run_command("track", HOME, [*typed, argument]) == 2
    assert capfd.readouterr().err == f"track: frames=/nope/{name}: no such folder\n"


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_a_console_that_lacks_a_sign_ends_no_run(
    encoding: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(shown, encoding, write_through=True))
    monkeypatch.setattr("posefilter.cli.generate.generate", lambda job: say("rich", "", "日本"))
    assert run_command("generate", HOME, [f"out={tmp_path / 'out'}"]) == 0
    assert shown.getvalue().endswith(b"\\u65e5\\u672c\n")


def test_an_export_overwrites_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The file may be the training's own, with its optimizer."""
    own = tmp_path / "own.ckpt"
    shutil.copy(HOME / "weights" / "003_cracker_box.ckpt", own)
    before = own.read_bytes()
    (tmp_path / "link.ckpt").symlink_to(own)
    for out in (own, tmp_path / "link.ckpt"):
        assert run_command("export", HOME, [f"checkpoint={own}", f"out={out}"]) == 2
        assert f"out={out}: already exists" in capfd.readouterr().err
    assert own.read_bytes() == before


def test_a_closed_pipe_is_told_as_one() -> None:
    assert "what it prints to was closed" in explain(BrokenPipeError(32, "x"), "track", HOME, [])


def test_what_a_preset_sets_for_another_choice_can_be_left_out() -> None:
    """Its number is one that the user has not typed."""
    error = UserError("model.net.hidden: LatentNet takes no such setting")
    typed = ["model=cnn_patch", "model/net=latent"]
    told = explain(error, "train", HOME / "conf", typed)
    assert told == f"{error}; '~model.net.hidden' leaves it out"
    assert explain(error, "train", HOME / "conf", [*typed, "model.net.hidden=9"]) == str(error)
