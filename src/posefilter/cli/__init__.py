"""The only part of the project that knows Hydra: from a command line to files in a folder."""

from typing import TYPE_CHECKING

from posefilter.lazy import import_lazily

if TYPE_CHECKING:
    from posefilter.cli.command import run_command
    from posefilter.cli.job import Job

__all__ = ["Job", "run_command"]

# Hydra is imported only where a command is run: reading a checkpoint needs none of it
__getattr__ = import_lazily(__name__, {"Job": "job", "run_command": "command"})
