"""Data-parallel training: which of its processes this is."""

import os
import subprocess
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from typing import Any

from posefilter.errors import ProblemsFound

STARTED = "POSEFILTER_COMMAND"  # environment variable: what the first process does
# The variables of a process's number, as Lightning, torchrun and Slurm set them, and that of how
# many there are. A number alone, as some clusters give their jobs, makes no training of several.
_RANKS = {"LOCAL_RANK": "WORLD_SIZE", "RANK": "WORLD_SIZE", "SLURM_PROCID": "SLURM_NTASKS"}


@cache
def is_follower() -> bool:
    """Tell whether this is another than the first of several processes of a training: the first
    writes, and says, for all of them.

    It is so from a process's start to its end; Lightning takes the variables away in between.
    """
    return any(
        os.environ.get(rank, "0") != "0" and os.environ.get(size, "1") not in ("", "0", "1")
        for rank, size in _RANKS.items()
    )


def check_others(others: Iterable[subprocess.Popen[Any]], wait: float = 60.0) -> None:
    """Wait for the other processes of a training that the first one has started, once it is done.

    One that is still at its own test after the wait is left alone: the results are the first's.

    Args:
        others: The processes.
        wait: How long for each, at most [s].

    Raises:
        ProblemsFound: One has failed, so that the command must not end as if all were well.
    """
    for rank, other in enumerate(others, 1):
        with suppress(subprocess.TimeoutExpired):
            status = other.wait(wait)
            if status != 0:
                how = f"by signal {-status}" if status < 0 else f"with exit status {status}"
                raise ProblemsFound(
                    f"process {rank} of this training ended {how}, after the first had trained; "
                    "the results that the first process has written are complete"
                )
