"""Data-parallel training: which of its processes this is."""

import os

STARTED = "POSEFILTER_COMMAND"  # environment variable: what the first process does
_RANKS = ("LOCAL_RANK", "RANK", "SLURM_PROCID")  # as Lightning, torchrun and Slurm set them


def is_follower() -> bool:
    """Tell whether this is another than the first of several processes of a training: the first
    writes, and says, for all of them.
    """
    return any(os.environ.get(rank, "0") != "0" for rank in _RANKS)
