"""What is settled before a run: memory that stays where it is."""

import multiprocessing
import os
import platform
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor

import pytest

from posefilter.cli.machine import settle_processes

TEN_LARGE = """
import resource, sys, torch
if sys.argv[1] == "keep":
    from posefilter.cli.machine import keep_freed_memory
    assert keep_freed_memory()
torch.ones(16_000_000)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    torch.ones(16_000_000)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(how: str) -> int:
    """Return how many pages ten tensors of 64 MB, one after the other, ask the system for."""
    clean = {key: value for key, value in os.environ.items() if not key.startswith("MALLOC_")}
    done = subprocess.run(
        [sys.executable, "-c", TEN_LARGE, how],
        capture_output=True,
        text=True,
        check=True,
        env=clean,
    )
    return int(done.stdout)


@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="another C library keeps its memory in its own way"
)
def test_freed_memory_is_kept_for_the_next_tensor() -> None:
    assert faults("keep") < faults("plain") / 5


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
