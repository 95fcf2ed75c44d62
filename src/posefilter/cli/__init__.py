"""The only part of the project that knows Hydra: from a command line to files in a folder."""

from posefilter.cli.command import run_command
from posefilter.cli.job import Job

__all__ = ["Job", "run_command"]
