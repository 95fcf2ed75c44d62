"""What is settled before a run: memory that stays where it is."""

import multiprocessing
import os
import platform
import random
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor

import lightning
import numpy as np
import pytest
import torch

from posefilter.cli.machine import device_name, settle, settle_processes

TEN_LARGE = """
import resource, torch
from posefilter.memory import keep_freed_memory

def faults():
    for _ in range(20):  # small objects take the front of a freed place: it settles after a few
        torch.ones(16_000_000)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        torch.ones(16_000_000)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

plain = faults()
assert keep_freed_memory()
print(plain, faults())
"""


def count_faults() -> list[int]:
    """Return how many pages ten tensors of 64 MB, one after the other and after twenty like them,
    ask the system for: in a new process, and where it keeps what it has freed.
    """
    clean = {key: value for key, value in os.environ.items() if not key.startswith("MALLOC_")}
    done = subprocess.run(
        [sys.executable, "-c", TEN_LARGE], capture_output=True, text=True, check=True, env=clean
    )
    return [int(word) for word in done.stdout.split()]


@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="another C library keeps its memory in its own way"
)
def test_freed_memory_is_kept_for_the_next_tensor() -> None:
    plain, kept = count_faults()
    assert kept < plain / 5


@pytest.mark.slow
def test_a_job_in_a_worker_of_joblib_can_start_processes_of_its_own() -> None:
    """As jobs of `hydra/launcher=joblib` do that render their scenes."""
    loky = pytest.importorskip("joblib.externals.loky", reason="pip install 'posefilter[sweep]'")
    with loky.ProcessPoolExecutor(1) as pool:
        assert pool.submit(_run_settled).result() == ("loky", 7)


def _run_settled() -> tuple[str, int]:
    before = multiprocessing.get_start_method()
    settle_processes()
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return before, pool.submit(abs, -7).result()


def test_a_gpu_that_was_not_used_is_not_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: f"GPU {device.index}")
    assert "threads" in device_name()
    assert "threads" in device_name(torch.device("cpu"))
    assert device_name(torch.device("cuda:1")) == "GPU 1"


def test_what_is_seeded_is_what_lightning_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("PL_GLOBAL_SEED", "PL_SEED_WORKERS"):
        monkeypatch.setenv(name, "")

    def draw() -> list[object]:
        own = [os.environ["PL_GLOBAL_SEED"], os.environ["PL_SEED_WORKERS"]]
        return [*own, random.random(), float(np.random.rand()), float(torch.rand(()))]  # noqa: NPY002

    lightning.seed_everything(7, workers=True, verbose=False)
    expected = draw()
    settle(torch.get_num_threads(), 8)
    assert draw() != expected
    settle(torch.get_num_threads(), 7)
    assert draw() == expected


@pytest.mark.parametrize("command", ["predict", "track", "convert_bag"])
@pytest.mark.slow
def test_commands_that_train_nothing_import_no_lightning(command: str) -> None:
    """That alone takes longer than an answer."""
    code = f"import sys, posefilter.cli.{command}; sys.exit('lightning' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
