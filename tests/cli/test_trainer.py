"""What a trainer may be told."""

import pytest
from omegaconf import OmegaConf

from posefilter.cli.build import make_trainer
from posefilter.errors import UserError

SETTINGS = {"_target_": "lightning.Trainer", "accelerator": "cpu", "max_steps": 1}


@pytest.mark.parametrize("precision", ["bf16-mixed", "16-true", "64-true"])
def test_a_precision_that_blurs_poses_is_refused(precision: str) -> None:
    with pytest.raises(UserError, match=rf"trainer\.precision={precision}: .*32-true"):
        make_trainer(OmegaConf.create({**SETTINGS, "precision": precision}), [])


def test_full_precision_is_taken() -> None:
    assert (
        make_trainer(OmegaConf.create({**SETTINGS, "precision": "32-true"}), []).precision
        == "32-true"
    )
