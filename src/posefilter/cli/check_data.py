"""Tell whether a dataset fits its meshes."""

from pathlib import Path

from omegaconf import DictConfig

from posefilter.cli.console import JSON, ended, typed
from posefilter.cli.instantiate import instantiate
from posefilter.cli.job import Job
from posefilter.data.checking.check import check_dataset, format_report
from posefilter.data.readers.registry import open_reader
from posefilter.errors import UserError
from posefilter.meshes.store import MeshStore
from posefilter.synthetic.generate import GENERATOR


def check_data(job: Job) -> None:
    """Write data_report.json and a contact sheet; print the table."""
    cfg = job.cfg
    if cfg.data.root is None:
        raise UserError("data.root: is missing; name the dataset's folder")
    store = MeshStore(cfg.meshes, scale=cfg.mesh_scale)
    options = instantiate(cfg.data.options, "data.options") or {}
    reader = open_reader(cfg.data.source, cfg.data.root, cfg.data.object, store, "skip", **options)
    report = check_dataset(
        reader, store, limit=cfg.limit, out=job.folder, progress=cfg.console != JSON
    )
    if cfg.console != JSON:
        print(format_report(report))
    files = {
        "report": job.folder / "data_report.json",
        "pictures": job.folder / "contact_sheet.png",
    }
    following = [] if report["problems"] else [train_on(cfg, name) for name in reader.objects]
    ended(
        cfg.console,
        "checked",
        {name: path for name, path in files.items() if path.is_file()},
        following,
        **report,
    )


def train_on(cfg: DictConfig, name: str) -> str:
    """Return the command that trains on an object of the data."""
    # what train.py takes by default
    rendered = cfg.data.source == "fat" and (Path(cfg.data.root) / GENERATOR).is_file()
    source = {} if rendered else {"data": cfg.data.source}
    return typed(
        "train", **source, data__root=cfg.data.root, data__object=name, data__meshes=cfg.meshes
    )
