"""The only part of the project that knows Hydra: from a command line to files in a folder."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from posefilter.cli.command import run_command
    from posefilter.cli.job import Job

__all__ = ["Job", "run_command"]


def __getattr__(name: str) -> Any:
    """Import Hydra only where a command is run: reading a checkpoint needs none of it."""
    if name == "Job":
        from posefilter.cli.job import Job

        return Job
    if name == "run_command":
        from posefilter.cli.command import run_command

        return run_command
    raise AttributeError(f"module 'posefilter.cli' has no attribute '{name}'")
