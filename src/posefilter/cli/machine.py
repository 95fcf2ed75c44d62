"""Threads, seeds, and what to remember of the machine and the code that made a result."""

import multiprocessing
import os
import platform
import random
import subprocess
from importlib import metadata
from pathlib import Path

import cv2
import numpy as np
import torch

from posefilter.memory import keep_freed_memory

_PACKAGES = (
    *("posefilter", "torch", "lightning", "hydra-core", "torchmetrics", "numpy", "scipy"),
    "opencv-python-headless",
)


def settle(threads: int | None, seed: int) -> None:
    """Use so many threads (null: what torch finds, OMP_NUM_THREADS included, at most 8), and seed
    what is not explicit.
    """
    keep_freed_memory()
    settle_processes()
    torch.set_num_threads(threads or min(8, torch.get_num_threads()))
    if threads:  # where it is not set, Lightning gives each of several processes its share of cores
        os.environ["OMP_NUM_THREADS"] = str(threads)
    cv2.setNumThreads(1)
    _seed_everything(seed)


def _seed_everything(seed: int) -> None:
    """Do what Lightning's function of this name does, whose import takes longer than an answer."""
    os.environ["PL_GLOBAL_SEED"], os.environ["PL_SEED_WORKERS"] = str(seed), "1"
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002, global on purpose: of code that takes no generator
    torch.manual_seed(seed)


def settle_processes() -> None:
    """Start processes in the system's usual way where a launcher has put another in its place.

    joblib's workers make `loky` the default, by name; processes that they spawn do not know it.
    """
    usual = multiprocessing.get_all_start_methods()
    if multiprocessing.get_start_method(allow_none=True) not in (None, *usual):
        multiprocessing.set_start_method(usual[0], force=True)


def versions() -> dict[str, str]:
    """Return the versions that decide a result."""
    out = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            out[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            out[name] = "not installed"
    return out


def device_name(device: torch.device | None = None) -> str:
    """Return the name of the GPU that was used, or how many processor threads are."""
    if device is not None and device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{platform.machine()}, {torch.get_num_threads()} threads"


def git_state() -> str | None:
    """Return the commit of the code, with `+` where files differ; None outside its clone."""
    home = Path(__file__).parent
    if not (home.parents[2] / ".git").exists():
        return None  # installed: a repository around it is another's

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", *arguments], cwd=home, capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    try:
        return git("rev-parse", "HEAD") + (
            "+" if git("status", "--porcelain", "--untracked-files=no") else ""
        )
    except (OSError, subprocess.CalledProcessError):
        return None
