"""Where to compute."""

import os

import torch

from posefilter.errors import UserError

_owner: int | None = None  # the process that has computed on several threads


def choose_device() -> str:
    """Return the device to compute on where none is asked for: the GPU where there is one."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def take_threads() -> None:
    """Note that this process is about to compute on torch's threads.

    Raises:
        UserError: It was forked from one that did so: OpenMP would wait without end for threads
            that only the other has.
    """
    global _owner
    if torch.get_num_threads() == 1:
        return
    if _owner not in (None, os.getpid()):
        raise UserError(
            "this process was forked from one that has loaded or used posefilter, without the "
            "threads of that one: start processes by multiprocessing.get_context('spawn'), or "
            "call torch.set_num_threads(1) in this one first"
        )
    _owner = os.getpid()
