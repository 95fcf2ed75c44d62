"""A run that was cut short ends as one that was not."""

import json
import os
import signal
from pathlib import Path

import pytest
import torch
from lightning import Callback, Trainer
from tests.smoke.conftest import HOME, SMALL_POSE_PF, TINY

from posefilter.cli import build, run_command
from posefilter.cli import train as training
from posefilter.cli.progress_bar import Lines
from posefilter.cli.resume import check_kept, check_override, list_unkept, with_resumed
from posefilter.errors import UserError


class Killed(BaseException):
    """What a killed process does not survive."""


class Killer(Lines):
    """Kills the run at a step."""

    def __init__(self, step: int) -> None:
        super().__init__()
        self.step = step

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx) -> None:  # type: ignore[no-untyped-def]
        if trainer.global_step == self.step:
            raise Killed


def state(folder: Path) -> dict:
    return torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "interval"),
    [("cnn_patch", 4), ("cnn_patch", 3), ("pose_pf", 3)],
    ids=["between epochs", "within an epoch", "with particles of its own"],
)
def test_a_killed_run_goes_on_to_the_same_end(
    model: str, interval: int, tiny_job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # type: ignore[no-untyped-def]
    settings = [
        f"model={model}",
        f"trainer.val_check_interval={interval}",
        f"trainer.max_steps={3 * interval}",
        *(SMALL_POSE_PF if model == "pose_pf" else []),
        f"callbacks={'default' if (model, interval) == ('cnn_patch', 3) else 'checkpoints'}",
    ]
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    training.train(tiny_job(whole, *settings))

    def killer(console: str) -> Callback:
        return Killer(interval + 1)

    monkeypatch.setattr(build, "progress", killer)
    with pytest.raises(Killed):
        training.train(tiny_job(cut, *settings))
    monkeypatch.undo()
    assert state(cut)["global_step"] == interval
    assert not (cut / "metrics.json").exists()

    training.train(tiny_job(cut, *settings, f"resume={cut}"))
    a, b = state(whole), state(cut)
    assert a["global_step"] == b["global_step"] == 3 * interval
    assert a["epoch"] == b["epoch"]
    for key, value in a["state_dict"].items():
        assert torch.equal(value, b["state_dict"][key]), key
    for one, other in zip(
        a["optimizer_states"][0]["state"].values(),
        b["optimizer_states"][0]["state"].values(),
        strict=True,
    ):
        for key in one:
            assert torch.equal(one[key], other[key]), key
    assert ("candidate_sampler" in a) == ("candidate_sampler" in b) == (model == "pose_pf")
    for key, value in a.get("candidate_sampler", {}).items():
        assert torch.equal(value, b["candidate_sampler"][key]), key
    assert a["lr_schedulers"][0]["_last_lr"] == b["lr_schedulers"][0]["_last_lr"]


class Sender(Lines):
    """Sends this process a signal after a batch of a step."""

    def __init__(self, hook: str, step: int, number: int) -> None:
        super().__init__()
        self.hook, self.step, self.number = hook, step, number

    def on_train_batch_end(self, trainer: Trainer, *_: object) -> None:
        self.send("training", trainer)

    def on_validation_batch_end(self, trainer: Trainer, *_: object) -> None:
        self.send("sanity check" if trainer.sanity_checking else "validation", trainer)

    def on_sanity_check_start(self, trainer: Trainer, *_: object) -> None:
        self.send("before the sanity check", trainer)

    def send(self, hook: str, trainer: Trainer) -> None:
        if (hook, trainer.global_step) == (self.hook, self.step):
            os.kill(os.getpid(), self.number)


@pytest.fixture(scope="module")
def uninterrupted(
    tiny_scenes: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[list[str], Path]:
    """Return a run that nothing stopped: what was typed, and its folder."""
    settings = [*TINY, f"data.root={tiny_scenes}", "model=cnn_patch", "callbacks=checkpoints"]
    settings += ["trainer.val_check_interval=3", "trainer.max_steps=6", "data.batch_size_test=2"]
    whole = tmp_path_factory.mktemp("runs") / "whole"
    assert run_command("train", HOME, [*settings, f"out={whole}"]) == 0
    return settings, whole


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hook", "step", "number"),
    [
        ("training", 2, signal.SIGINT),
        ("training", 4, signal.SIGTERM),
        ("validation", 3, signal.SIGTERM),
    ],
    ids=["within an epoch", "at its end", "within a validation"],
)
def test_a_stopped_run_prints_how_to_resume_and_ends_the_same(
    hook: str,
    step: int,
    number: int,
    uninterrupted: tuple[list[str], Path],
    tiny_scenes: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    settings, whole = uninterrupted
    cut = tmp_path / "cut"
    with monkeypatch.context() as patch:
        patch.setattr(build, "progress", lambda console: Sender(hook, step, number))
        before = signal.getsignal(number)
        assert run_command("train", HOME, [*settings, f"out={cut}"]) == 128 + number
        assert signal.getsignal(number) == before
    told = json.loads(capfd.readouterr().out.splitlines()[-1])
    again = f"data.root={tiny_scenes}"  # outside of the working folder: no record decides on it
    following = f"python train.py resume={cut} {again}"
    assert told == {"event": "stopped", "step": step, "next": following}
    assert state(cut)["global_step"] == step
    assert not (cut / "metrics.json").exists()

    last, before = (cut / "checkpoints" / name for name in ("last.ckpt", "last.previous.ckpt"))
    if before.is_file():
        last.write_bytes(last.read_bytes()[:1000])
    assert run_command("train", HOME, [f"resume={cut}", again]) == 0
    events = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    fallen_back = [event["checkpoint"] for event in events if event["event"] == "fallback"]
    assert fallen_back == ([str(before)] if (hook, step) == ("training", 4) else [])
    a, b = state(whole), state(cut)
    assert (a["global_step"], a["epoch"]) == (b["global_step"], b["epoch"])
    assert all(torch.equal(value, b["state_dict"][key]) for key, value in a["state_dict"].items())
    one, other = (json.loads((run / "metrics.json").read_text()) for run in (whole, cut))
    assert one["iou"] == other["iou"]
    assert one["training"]["tested_step"] == other["training"]["tested_step"]


@pytest.mark.slow
@pytest.mark.parametrize("hook", ["before the sanity check", "sanity check"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_before_the_first_step_stops_the_run(
    hook: str,
    number: int,
    tiny_scenes: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(build, "progress", lambda console: Sender(hook, 0, number))
    settings = [*TINY, f"data.root={tiny_scenes}", "model=cnn_patch", "callbacks=checkpoints"]
    settings += ["trainer.num_sanity_val_steps=2", f"out={tmp_path / 'run'}"]
    started = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background
    try:
        before = signal.getsignal(number)
        assert run_command("train", HOME, settings) == 128 + number
        assert signal.getsignal(number) == before
    finally:
        signal.signal(signal.SIGINT, started)
    told = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert told == {"event": "stopped", "step": 0, "next": None}


def test_a_run_that_cannot_go_on_with_what_is_typed_keeps_its_settings(
    tmp_path: Path, tiny_scenes: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    (run / ".hydra").mkdir(parents=True)
    (run / "checkpoints").mkdir()
    (run / "checkpoints" / "last.ckpt").write_bytes(b"")
    record = run / ".hydra" / "overrides.yaml"
    record.write_text("- model=cnn_patch\n- debug=smoke\n")
    before = record.read_bytes()
    typed = [f"resume={run}", f"data.root={tiny_scenes}", "console=json"]
    assert run_command("train", HOME, [*typed, "data.image_width=nope"]) == 2
    assert "nope" in capfd.readouterr().err
    assert record.read_bytes() == before
    # and so where what is left of the checkpoint is the reason
    assert run_command("train", HOME, [*typed, "model.net.width=8"]) == 2
    assert record.read_bytes() == before


@pytest.mark.slow
@pytest.mark.parametrize(
    ("typed", "told"),
    [
        ("optimizer.lr=1", "optimizer.lr=1: the run began with another"),
        ("seed=1", "seed=1: the run began with another"),
        ("data.split={test: 1.0}", "data.split={test: 1.0}: the run began with another"),
        ("model=patch_pf", "model=patch_pf: the run began with another"),
        ("loss=add", "loss=add: the run began with another"),
        ("data.batch_size=3", "data.batch_size=3: the run began with another"),
        ("warm_start=all", "warm_start=all: the run began with another"),
        ("out=elsewhere", "a run that is resumed stays in its folder"),
        ("model.net.width=8", "holds other networks than these settings"),
    ],
)
def test_a_resumed_run_keeps_what_it_began_with(
    typed: str,
    told: str,
    uninterrupted: tuple[list[str], Path],
    tiny_scenes: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    _, whole = uninterrupted
    resumed = [f"resume={whole}", f"data.root={tiny_scenes}", "seed=0", "model=cnn_patch"]
    before = (whole / ".hydra" / "overrides.yaml").read_bytes()
    assert run_command("train", HOME, [*resumed, "trainer.max_steps=8", typed]) == 2
    (line,) = capfd.readouterr().err.splitlines()[-1:]
    assert told in line
    assert "Traceback" not in line
    assert (whole / ".hydra" / "overrides.yaml").read_bytes() == before


def test_what_a_run_began_with_may_be_typed_again_in_other_words(tmp_path: Path) -> None:
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "config.yaml").write_text(
        "optimizer: {lr: 0.001}\nseed: 3\ndata: {split: {train: 0.8, val: 0.2}, object: '12'}\n"
    )
    choices = "hydra: {runtime: {choices: {model: patch_pf}}}\n"
    (tmp_path / ".hydra" / "hydra.yaml").write_text(choices)
    for typed in (
        "optimizer.lr=1e-3", "optimizer.lr=0.001", "seed=3", "data.split={train:0.8,val: 0.2}",
        "model=patch_pf", "data.object='12'", f"out={tmp_path}", "trainer.max_steps=7", "--cfg",
    ):  # fmt: skip
        check_kept(typed, tmp_path)
    for typed in (
        "optimizer.lr=1e-4",
        "seed=3,4",
        "data.split={train:0.8,val:0.1}",
        "model=pose_pf",
    ):
        with pytest.raises(UserError, match="the run began with another"):
            check_kept(typed, tmp_path)


def test_a_folder_whose_name_is_typed_in_quotes_is_resumed(tmp_path: Path) -> None:
    folder = tmp_path / "lr=0.1,a"
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text("- seed=3\n")
    (folder / "checkpoints").mkdir()
    (folder / "checkpoints" / "last.ckpt").touch()
    arguments = with_resumed([f"resume='{folder}'"])
    assert arguments[0] == "seed=3"
    assert arguments[-1] == f"out={folder}"


def test_what_a_run_had_added_is_taken_away_when_it_is_resumed(tmp_path: Path) -> None:
    (tmp_path / ".hydra").mkdir()
    begun = ["+callbacks.early={patience: 1}", "+trainer.max_time=00:01:00:00", "seed=3"]
    (tmp_path / ".hydra" / "overrides.yaml").write_text(json.dumps(begun))
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "last.ckpt").touch()
    typed = [f"resume={tmp_path}", "~callbacks.early", "~trainer.max_time", "~callbacks.layout"]
    assert with_resumed(typed) == [
        *("seed=3", f"resume={tmp_path}", "~callbacks.layout", f"out={tmp_path}"),
    ]


def test_a_job_of_a_chosen_sweep_is_resumed_by_itself(tmp_path: Path) -> None:
    job = tmp_path / "ablation=paper,sweep=ablation"
    (job / ".hydra").mkdir(parents=True)
    (job / ".hydra" / "overrides.yaml").write_text("- ablation=paper\n- sweep=ablation\n")
    (job / "checkpoints").mkdir()
    (job / "checkpoints" / "last.ckpt").touch()
    arguments = with_resumed([f"resume='{job}'"])
    # the choice of the sweep brings settings of its jobs, and would start all of them
    assert arguments == [
        *("ablation=paper", "sweep=ablation"),
        *(f"resume='{job}'", f"out={job}", "hydra.mode=RUN"),
    ]


def test_what_a_record_may_not_bring_is_named_as_it_is_to_be_typed() -> None:
    brought = ["model=patch_pf", "data.root=data/mine", "callbacks=checkpoints", "out=/elsewhere"]
    refused = ["logger=wandb", "logger=[csv,wandb]", "data.root=/mine/two words"]
    assert list_unkept(brought) == []
    assert list_unkept([*brought, *refused]) == [
        *("logger=wandb", "'logger=[csv,wandb]'", "'data.root=/mine/two words'"),
    ]
    for one in refused:
        with pytest.raises(UserError, match=f"its {one.partition('=')[0]}="):
            check_override(one)


@pytest.mark.slow
def test_a_run_is_resumed_where_what_it_began_with_is_gone(
    uninterrupted: tuple[list[str], Path], tiny_scenes: Path, tmp_path: Path
) -> None:
    settings, whole = uninterrupted
    first, cut = tmp_path / "first.ckpt", tmp_path / "cut"
    first.write_bytes((whole / "checkpoints" / "best.ckpt").read_bytes())
    begun = [*settings, f"warm_start={first}", f"out={cut}", "trainer.max_steps=3"]
    assert run_command("train", HOME, begun) == 0
    first.unlink()
    again = [f"resume={cut}", f"data.root={tiny_scenes}", f"warm_start={first}"]
    assert run_command("train", HOME, [*again, "trainer.max_steps=6"]) == 0
    assert state(cut)["global_step"] == 6
