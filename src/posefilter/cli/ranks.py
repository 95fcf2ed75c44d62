"""Data-parallel training: which of its processes this is."""

import os
from functools import cache

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
