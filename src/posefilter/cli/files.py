"""Files that are whole or not there: written beside their target, synced, then renamed."""

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import torch
from lightning.fabric.plugins.io import TorchCheckpointIO

from posefilter.errors import UserError


@contextmanager
def open_whole(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing that takes its name only when all of it is on the disk.

    Raises:
        UserError: It cannot be written, as on a full disk.  What had the name before still has it.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise UserError(f"{path}: cannot be written ({error.strerror or error})") from error
        raise


def save_whole(content: Any, path: Path) -> None:
    """Save what torch can save, whole or not at all."""
    buffer = io.BytesIO()  # torch's own writer tells a full disk as a bug of its own
    torch.save(content, buffer)
    with open_whole(path) as file:
        file.write(buffer.getbuffer())


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
