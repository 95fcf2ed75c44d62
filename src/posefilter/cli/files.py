"""Checkpoints that are whole or not there."""

import io
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.io import TorchCheckpointIO

from posefilter.files import write_whole


def pack_whole(content: Any) -> memoryview:
    """Return the bytes of what torch can save."""
    buffer = io.BytesIO()  # torch's own writer tells a full disk as a bug of its own
    torch.save(content, buffer)
    return buffer.getbuffer()


def save_whole(content: Any, path: Path) -> None:
    """Save what torch can save, whole or not at all."""
    write_whole(path, pack_whole(content), sync=True)


class WholeCheckpoints(TorchCheckpointIO):
    """Lightning's way to write checkpoints, but whole or not at all.

    Its own goes by way of the temporary folder: on another filesystem a kill, or a full disk,
    leaves half a checkpoint under the real name.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        """Write a checkpoint."""
        save_whole(checkpoint, Path(path))
