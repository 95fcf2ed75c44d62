"""Checkpoints that are whole or not there."""

import io
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.io import TorchCheckpointIO
from torch.utils.serialization import config

from posefilter.files import write_whole

# of the tensors in a file [bytes]; torch's own 64 leaves gaps between many small ones
_ALIGNMENT = {"save.storage_alignment": 8}


def pack_whole(content: Any) -> memoryview:
    """Return the bytes of what torch can save."""
    buffer = io.BytesIO()  # torch's own writer tells a full disk as a bug of its own
    newer = hasattr(config.save, "storage_alignment")  # not in the oldest torch that is supported
    # torch adds `patch` when it is imported
    with config.patch(_ALIGNMENT) if newer else nullcontext():  # type: ignore[attr-defined]
        torch.save(content, buffer)
    return buffer.getbuffer()


def save_whole(content: Any, path: Path) -> None:
    """Save what torch can save, whole or not at all."""
    write_whole(path, pack_whole(content), sync=True)


class WholeCheckpoints(TorchCheckpointIO):
    """Lightning's way to write checkpoints, but whole or not at all.

    Its own goes by way of the temporary folder: on another filesystem a kill, or a full disk,
    leaves half a checkpoint under the real name.

    Attributes:
        seconds: What the writing of all checkpoints has taken so far.
    """

    seconds = 0.0

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        """Write a checkpoint."""
        began = time.perf_counter()
        save_whole(checkpoint, Path(path))
        self.seconds += time.perf_counter() - began
