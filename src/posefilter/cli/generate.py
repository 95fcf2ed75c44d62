"""Render a dataset in the FAT format."""

from pathlib import Path

from posefilter.cli.console import JSON, ended, typed
from posefilter.cli.instantiate import instantiate
from posefilter.cli.job import Job
from posefilter.data.readers.registry import open_reader
from posefilter.errors import UserError
from posefilter.figures.canvas import save_image
from posefilter.figures.preview import draw_preview
from posefilter.meshes.store import MeshStore
from posefilter.synthetic.generate import Summary


def generate(job: Job) -> None:
    """Render the frames that are still missing, and a picture of some."""
    if job.cfg.out is None:
        raise UserError("out: is missing; name the folder that the dataset goes to")
    shown = bool(job.cfg.progress) and job.cfg.console != JSON
    summary = instantiate({**job.cfg.generate, "progress": shown}, "generate")
    assert isinstance(summary, Summary)
    preview = draw(summary, job)
    if job.cfg.console != JSON:
        speed = f" ({summary.frames_per_second:.1f} frames/s)" if summary.rendered else ""
        print(
            f"{summary.frames} frames in {summary.folders} folders, {summary.rendered} of them "
            f"rendered now{speed}"
        )
    made = {"data__root": summary.out, "data__object": job.cfg.object, "meshes": job.cfg.meshes}
    made |= {} if job.cfg.mesh_scale is None else {"mesh_scale": job.cfg.mesh_scale}
    files = {"data": summary.out} | ({"preview": preview} if preview else {})
    ended(
        job.cfg.console,
        "generated",
        files,
        [typed("check_data", data="fat", **made)],
        frames=summary.frames,
        rendered=summary.rendered,
        frames_per_second=summary.frames_per_second,
    )


def draw(summary: Summary, job: Job) -> Path | None:
    """Write preview.png, four of the frames at most; return None where none shows the object."""
    name = job.cfg.object
    # the instances of a class are told apart by its mesh
    several = job.cfg.instances > 1
    meshes = MeshStore(job.cfg.meshes, scale=job.cfg.mesh_scale or 1.0) if several else None
    reader = open_reader("scenes", summary.out, name, meshes)
    path = summary.out / "preview.png"
    picture = draw_preview(reader, name, summary.frames)
    if picture is None:
        return None
    save_image(picture, path)
    return path
