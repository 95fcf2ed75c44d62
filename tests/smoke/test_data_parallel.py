"""Training in two processes of one machine, as Lightning starts them."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from tests.smoke.conftest import TINY

HOME = Path(__file__).parents[2]


def command(scenes: Path, out: Path, steps: int, *more: str) -> tuple[list[str], dict[str, str]]:
    """Return what starts a training in two processes, and its environment."""
    words = [*TINY, f"data.root={scenes}", "model=cnn_patch", "callbacks=checkpoints"]
    words += ["trainer.accelerator=cpu", "trainer.devices=2", f"trainer.max_steps={steps}"]
    words += ["trainer.strategy=ddp_find_unused_parameters_true", "threads=1", f"out={out}"]
    words += [f"trainer.val_check_interval={steps}", "data.batch_size=2", "console=json", *more]
    clean = {k: v for k, v in os.environ.items() if "RANK" not in k and "WORLD" not in k}
    return [sys.executable, str(HOME / "train.py"), *words], clean


@pytest.mark.slow
@pytest.mark.parametrize("installed", [False, True])
def test_two_processes_train_one_method(tmp_path: Path, tiny_scenes: Path, installed: bool) -> None:
    out = tmp_path / "run"
    words, clean = command(tiny_scenes, out, 2)
    if installed:  # its other process is started without the word `train`
        words[:2] = [str(Path(sys.executable).parent / "posefilter"), "train"]
    done = subprocess.run(
        words, capture_output=True, text=True, timeout=600, cwd=tmp_path, env=clean
    )
    assert done.returncode == 0, done.stderr
    events = [json.loads(line) for line in done.stdout.splitlines() if line[:1] == "{"]
    # one process speaks
    assert [event["event"] for event in events].count("trained") == 1
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["training"]["steps"] == 2
    # each has tested all images, and counts none twice
    assert metrics["instances"] == metrics["data"]["splits"]["test"]["frames"]


@pytest.mark.slow
def test_a_process_that_fails_in_the_test_fails_the_command(
    tmp_path: Path, tiny_scenes: Path
) -> None:
    """The first has tested by then, and its results are kept."""
    (tmp_path / "own_callbacks.py").write_text(
        "from lightning import Callback\n\n\n"
        "class Failing(Callback):\n"
        "    def on_test_end(self, trainer, method):\n"
        "        if trainer.global_rank == 1:\n"
        "            raise ValueError('here')\n"
    )
    more = "plugins=[own_callbacks]", "+callbacks.failing._target_=own_callbacks.Failing"
    words, clean = command(tiny_scenes, tmp_path / "run", 2, *more)
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        words, capture_output=True, text=True, timeout=600, cwd=tmp_path,
        env=clean | {"PYTHONPATH": path},
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    told = "train: process 1 of this training ended with exit status 1"
    assert any(line.startswith(told) for line in done.stderr.splitlines())
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["training"]["steps"] == 2


@pytest.mark.slow
def test_only_the_first_process_draws(tmp_path: Path, tiny_scenes: Path) -> None:
    """The others have no event file to draw into."""
    out = tmp_path / "run"
    more = "callbacks=default", "logger=tensorboard"
    words, clean = command(tiny_scenes, out, 2, *more)
    words.remove("callbacks=checkpoints")
    done = subprocess.run(
        words, capture_output=True, text=True, timeout=600, cwd=tmp_path, env=clean
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert list(out.rglob("test_trajectories_*.jpg"))


@pytest.mark.slow
def test_two_processes_agree_on_when_to_write_what_a_run_goes_on_from(
    tmp_path: Path, tiny_scenes: Path
) -> None:
    """Their clocks differ: one that wrote alone would wait for the other for ever."""
    out = tmp_path / "run"
    words, clean = command(tiny_scenes, out, 40, "callbacks.last.minutes=0.012")
    done = subprocess.run(
        words, capture_output=True, text=True, timeout=300, cwd=tmp_path, env=clean
    )
    assert done.returncode == 0, done.stderr
    # several were written on the way, and the last is whole
    assert (out / "checkpoints" / "last.previous.ckpt").is_file()
    assert torch.load(out / "checkpoints" / "last.ckpt", weights_only=True)["global_step"] == 40


@pytest.mark.slow
def test_two_processes_stop_together(tmp_path: Path, tiny_scenes: Path) -> None:
    """A signal reaches them at different steps; the run is left where it can be gone on with."""
    out = tmp_path / "run"
    last = out / "checkpoints" / "last.ckpt"
    words, clean = command(tiny_scenes, out, 4000, "callbacks.last.minutes=0.012")
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path,
        env=clean, start_new_session=True,
    ) as process:  # fmt: skip
        while not last.is_file() and process.poll() is None:  # both train
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal's Ctrl-C does
        output, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert "Traceback" not in err
    stopped = json.loads(output.splitlines()[-1])
    assert stopped["event"] == "stopped"
    assert torch.load(last, weights_only=True)["global_step"] == stopped["step"] > 0
