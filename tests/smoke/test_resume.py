"""A run that was cut short ends as one that was not."""

from pathlib import Path

import pytest
import torch
from lightning import Callback

from posefilter.cli import train as training
from posefilter.cli.progress_bar import Lines


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
    ]
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    training.train(tiny_job(whole, *settings))

    def killer(console: str) -> Callback:
        return Killer(interval + 1)

    monkeypatch.setattr(training, "progress", killer)
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
    assert ("lesson" in a) == ("lesson" in b) == (model == "pose_pf")
    for key, value in a.get("lesson", {}).items():
        assert torch.equal(value, b["lesson"][key]), key
    assert a["lr_schedulers"][0]["_last_lr"] == b["lr_schedulers"][0]["_last_lr"]
