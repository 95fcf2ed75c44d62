"""Every choice of augmentation builds, and gives a sample that a network can read."""

from pathlib import Path

import numpy as np
import pytest
from tests.data.test_photometric import sample

from posefilter.cli.command import compose_job
from posefilter.cli.instantiate import instantiate

CONF = Path(__file__).parents[2] / "conf"
CHOICES = sorted(path.stem for path in (CONF / "data" / "augment").glob("*.yaml"))


@pytest.mark.parametrize("choice", CHOICES)
def test_every_augmentation_builds_and_runs(choice: str, tmp_path: Path) -> None:
    cfg = compose_job("train", CONF, [f"data/augment={choice}"], tmp_path).cfg
    augment = instantiate(cfg.data.augment, "data.augment")
    if augment is None:
        assert choice == "none"
        return
    seen = set()
    for seed in range(8):
        out = augment(sample(), lambda rng: sample(9), np.random.default_rng(seed))
        assert out.rgb.dtype == np.uint8
        assert out.rgb.shape[:2] == out.depth.shape == out.mask.shape
        assert np.isfinite(out.depth).all()
        seen.add(out.rgb.tobytes())
    assert len(seen) == 8
