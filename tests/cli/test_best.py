"""Which of a run's validations is tested."""

from pathlib import Path

import pytest
import torch
from lightning import LightningModule, Trainer
from torch import Tensor, nn
from torch.utils.data import DataLoader

from posefilter.cli.best import Best


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
