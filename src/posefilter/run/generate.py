"""Render a dataset in the FAT format."""

from posefilter.data.generate import Summary
from posefilter.errors import UserError
from posefilter.run.build import instantiate
from posefilter.run.job import Job


def generate(job: Job) -> None:
    """Render the frames that are still missing."""
    if job.cfg.out is None:
        raise UserError("out: is missing; name the folder that the dataset goes to")
    summary = instantiate(job.cfg.generate, "generate")
    assert isinstance(summary, Summary)
    print(
        f"{summary.out}: {summary.frames} frames in {summary.folders} folders, {summary.rendered} of them now "
        f"({summary.frames_per_second:.1f} frames/s)"
    )
