"""Tell whether a dataset fits its meshes."""

from posefilter.data.check import check_dataset, format_report
from posefilter.data.meshes import MeshStore
from posefilter.data.readers import open_reader
from posefilter.errors import UserError
from posefilter.run.build import instantiate
from posefilter.run.job import Job


def check_data(job: Job) -> None:
    """Write data_report.json and a contact sheet; print the table."""
    cfg = job.cfg
    if cfg.data.root is None:
        raise UserError("data.root: is missing; name the dataset's folder")
    store = MeshStore(cfg.meshes, scale=cfg.mesh_scale)
    options = instantiate(cfg.data.options, "data.options") or {}
    reader = open_reader(cfg.data.source, cfg.data.root, cfg.data.object, store, "skip", **options)
    report = check_dataset(reader, store, limit=cfg.limit, out=job.folder, progress=cfg.console == "rich")
    print(format_report(report))
    print(f"report: {job.folder / 'data_report.json'}")
