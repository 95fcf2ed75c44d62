"""Which of a run's validations is tested."""

import logging
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import LightningModule, Trainer
from torch import Tensor, nn
from torch.utils.data import DataLoader

from posefilter.cli.best import Best, Last, check_kept
from posefilter.errors import UserError


class Scored(LightningModule):
    """A module whose validations have given scores."""

    def __init__(self, scores: list[float]) -> None:
        super().__init__()
        self.scores = iter(scores)
        self.weight = nn.Parameter(torch.zeros(()))

    def training_step(self, batch: Tensor, index: int) -> Tensor:
        return self.weight.square()

    def validation_step(self, batch: Tensor, index: int) -> None:
        self.log("val/score", next(self.scores))

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


@pytest.mark.parametrize(
    ("scores", "step"),
    [([0.0, 0.0, 0.0], 3), ([0.0, 5.0, 5.0], 3), ([5.0, 5.0, 1.0], 2), ([1.0, 9.0, 3.0], 2)],
)
def test_of_equal_validations_the_latest_is_kept(
    scores: list[float], step: int, tmp_path: Path
) -> None:
    keep = Best(
        dirpath=tmp_path,
        filename="best",
        monitor="val/score",
        mode="max",
        enable_version_counter=False,
    )
    trainer = Trainer(
        max_epochs=3,
        callbacks=[keep],
        logger=False,
        accelerator="cpu",
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
    )
    one = DataLoader([torch.zeros(1)])
    trainer.fit(Scored(scores), one, one)
    assert torch.load(tmp_path / "best.ckpt", weights_only=True)["global_step"] == step
    assert [path.name for path in tmp_path.iterdir()] == ["best.ckpt"]


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"dirpath": "elsewhere"}, "callbacks.best.dirpath=.*elsewhere: .*checkpoints"),
        ({"filename": "good"}, "callbacks.best.filename=good: must be best"),
        ({"save_top_k": 3}, "callbacks.best.save_top_k=3: must be 1"),
        ({"save_top_k": 0}, "callbacks.best.save_top_k=0: must be 1"),
        ({"monitor": "None"}, "callbacks.best.monitor=None: must be .*val/score"),
    ],
)
def test_a_run_whose_best_checkpoint_would_not_be_found_is_refused_before_it(
    wrong: dict[str, Any], told: str, tmp_path: Path
) -> None:
    folder = tmp_path / "checkpoints"
    right = {"dirpath": folder, "filename": "best", "monitor": "val/score"}
    last = Last(str(folder))
    check_kept([last, Best(**right)], tmp_path)
    with pytest.raises(UserError, match=told):
        check_kept([last, Best(**(right | wrong))], tmp_path)
    with pytest.raises(UserError, match=r"callbacks\.best: is missing"):
        check_kept([last], tmp_path)
    with pytest.raises(UserError, match=r"callbacks\.last\.dirpath"):
        check_kept([Last(str(tmp_path)), Best(**right)], tmp_path)


def test_saving_says_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    trainer = Trainer(
        max_steps=1,
        callbacks=[Last(str(tmp_path), minutes=0)],
        logger=False,
        accelerator="cpu",
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    with caplog.at_level(logging.INFO):
        trainer.fit(Scored([]), DataLoader([torch.zeros(1)]))
        assert (tmp_path / "last.ckpt").is_file()
        assert "weights_only" not in caplog.text
        trainer.save_checkpoint(tmp_path / "other.ckpt")  # what Lightning says by itself
    assert "weights_only" in caplog.text
