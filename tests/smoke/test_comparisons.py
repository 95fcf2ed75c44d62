"""The comparisons through the commands: trained twice alike, tested, and used to predict."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

import posefilter
from posefilter.cli.job import Job
from posefilter.cli.train import train
from posefilter.metrics.image_errors import read_errors

FEWER_CELLS = ["model.cells=50", "model.train_cells=16", "filter/refine=none"]
FEW = {
    "dense_coordinates": ["model.proposals.widths=[16,24,32,32]", "model.proposals.fragments=8"],
    "keypoints": ["model.net.widths=[16,24,32,32]", "model.net.width=16"],
    "rotation_grid": ["model.net.widths=[16,24,32,32]", *FEWER_CELLS],
}


@pytest.mark.slow
@pytest.mark.parametrize("model", FEW)
def test_a_training_repeats_and_its_checkpoint_predicts(
    model: str, tiny_job: Callable[..., Job], tmp_path: Path
) -> None:
    states = []
    for name in ("a", "b"):
        job = tiny_job(tmp_path / name, f"model={model}", "trainer.max_steps=2", *FEW[model])
        train(job)
        path = tmp_path / name / "checkpoints" / "best.ckpt"
        states.append(torch.load(path, weights_only=True)["state_dict"])
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(states[0][key], states[1][key]) for key in states[0])
    metrics, again = (
        json.loads((tmp_path / name / "metrics.json").read_text()) for name in ("a", "b")
    )
    for key in ("add", "add_s", "iou", "particles_on_object", "belief", "by_visibility"):
        assert metrics[key] == again[key], key
    assert len(read_errors(tmp_path / "a" / "errors.csv")) == metrics["instances"] > 0
    found = posefilter.load(tmp_path / "a" / "checkpoints" / "best.ckpt").predict(
        np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8),
        np.full((120, 160), 0.9, dtype=np.float32),
        np.array([[180.0, 0, 79.5], [0, 180.0, 59.5], [0, 0, 1]]),
    )
    assert found.belief.samples.shape == (16, 4, 4)  # as many hypotheses as debug=smoke has
    scores = found.belief.weights
    assert np.allclose(found.pose, found.belief.samples[scores.argmax()], atol=1e-5)
