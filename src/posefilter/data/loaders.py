"""Data loaders, and the number of their processes."""

import os
from typing import Any

import cv2
import torch

from posefilter.data.dataset import FrameDataset, ResumableLoader
from posefilter.errors import UserError
from posefilter.signals import leave_signals_to_parent


def spare_cores() -> int:
    """Return the number of loader processes, 4 at most: the cores that torch's threads do not use.

    With a GPU that is all but one. The threads of one operation wait for each other, so a process
    that takes the core of one delays all of them.
    """
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    busy = 1 if torch.cuda.is_available() else torch.get_num_threads()
    return max(0, min(4, cores - busy))


def count_batches(there: int, limit: int | float) -> int:
    """Return how many batches an epoch takes of those that are there, as Lightning counts them.

    Args:
        there: Batches of the loader.
        limit: The trainer's `limit_train_batches`: a number, or a share.
    """
    return min(there, limit) if isinstance(limit, int) else int(limit * there)


def make_loader(
    dataset: FrameDataset, batch_size: int, workers: int, *, for_gpu: bool = False, **options: Any
) -> ResumableLoader:
    """Return a loader that can be resumed.

    Args:
        dataset: The frames.
        batch_size: Frames of a batch.
        workers: Loader processes.
        for_gpu: Whether batches go to a GPU by CUDA, which takes them faster from pinned memory.
        **options: Others of `DataLoader`.

    Raises:
        UserError: Images of a batch would be of several sizes.
    """
    sizes = list(dataset.sizes().items()) if batch_size > 1 else []
    if len(sizes) > 1:
        told = " and ".join(f"{name} is {width}x{height}" for (height, width), name in sizes[:2])
        raise UserError(
            f"{told}: images of a batch are of one size; data.batch_size=1 data.batch_size_test=1 "
            f"take them one by one, data.split can name the scenes of one size"
        )
    # a forked worker would wait for ever for OpenCV threads that only its parent has
    if workers > 0:
        cv2.setNumThreads(1)
    return ResumableLoader(
        dataset,
        batch_size=batch_size,
        num_workers=workers,
        persistent_workers=workers > 0,
        worker_init_fn=leave_signals_to_parent,
        pin_memory=for_gpu,
        **options,
    )
