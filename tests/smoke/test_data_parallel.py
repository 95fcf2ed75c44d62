"""Training in two processes of one machine, as Lightning starts them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from tests.smoke.conftest import TINY

HOME = Path(__file__).parents[2]


@pytest.mark.slow
def test_two_processes_train_one_method(tmp_path: Path, tiny_scenes: Path) -> None:
    out = tmp_path / "run"
    words = [*TINY, f"data.root={tiny_scenes}", "model=cnn_patch", "callbacks=checkpoints"]
    words += ["trainer.accelerator=cpu", "trainer.devices=2", "trainer.max_steps=2"]
    words += ["trainer.strategy=ddp_find_unused_parameters_true", "threads=1", f"out={out}"]
    words += ["trainer.val_check_interval=2", "data.batch_size=2", "console=json"]
    command = [sys.executable, str(HOME / "train.py"), *words]
    clean = {k: v for k, v in os.environ.items() if "RANK" not in k and "WORLD" not in k}
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=600, cwd=tmp_path, env=clean
    )
    assert done.returncode == 0, done.stderr
    events = [json.loads(line) for line in done.stdout.splitlines() if line[:1] == "{"]
    # one process speaks
    assert [event["event"] for event in events].count("trained") == 1
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["training"]["steps"] == 2
    # each has tested all images, and counts none twice
    assert metrics["instances"] == metrics["data"]["splits"]["test"]["frames"]
