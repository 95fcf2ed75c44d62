"""Command lines that make no sense end in one line that names what is wrong, and leave nothing."""

import json
from pathlib import Path

import pytest
import torch

from posefilter.cli import run_command
from posefilter.cli.build import make_trainer
from posefilter.cli.command import compose_job
from posefilter.cli.explain import explain_hydra
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
    "a number as a copy": (
        "calibrate",
        ["checkpoint=003_cracker_box", "out=0.5"],
        "out=0.5: ",
    ),
    "a word for true": (
        "calibrate",
        ["checkpoint=003_cracker_box", "replace=no"],
        "replace=no: choose true or false",
    ),
    "no model": ("train", ["model=null"], "model=null: cannot be read"),
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
        ["mesh=carton", "settings=5"],
        "settings=5: must be a list",
    ),
    "a mapping among settings": (
        "onboard",
        ["mesh=carton", "settings=[{a: 1}]"],
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


def test_a_launcher_that_fails_is_named() -> None:
    """And no other choice is blamed, as it is where Hydra's own code fails."""
    typed = ["debug=smoke", "hydra/launcher=submitit_slurm", "seed=0,1"]
    for file, told in (
        ("/x/hydra_plugins/y.py", "hydra/launcher=submitit_slurm: has failed (no srun)"),
        ("/x/hydra/y.py", "debug=smoke: cannot be read (no srun)"),
    ):
        with pytest.raises(RuntimeError) as caught:
            exec(compile("raise RuntimeError('no srun\\nhere')", file, "exec"))
        assert explain_hydra(caught.value, HOME / "conf", typed) == told
