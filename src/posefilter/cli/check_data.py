"""Tell whether a dataset fits its meshes."""

import re
import shlex
from collections import Counter
from pathlib import Path
from typing import Any

from posefilter.checking.check import check_dataset, format_report
from posefilter.cli.console import JSON, ended, typed
from posefilter.cli.instantiate import instantiate
from posefilter.cli.job import Job
from posefilter.data.readers.registry import open_meshes, open_reader
from posefilter.errors import ProblemsFound, UserError
from posefilter.synthetic.generate import GENERATOR

_FEW_IMAGES = 100


def check_data(job: Job) -> None:
    """Write data_report.json and a contact sheet; print the table.

    Raises:
        ProblemsFound: The data have problems; they are printed and in the report.
    """
    cfg = job.cfg
    if cfg.data.root is None:
        raise UserError("data.root: is missing; name the dataset's folder")
    options = instantiate(cfg.data.options, "data.options") or {}
    asked = (cfg.data.meshes, cfg.data.mesh_scale, cfg.data.source, cfg.data.object)
    store = open_meshes(*asked, options.get("mesh_frame"))
    reader = open_reader(cfg.data.source, cfg.data.root, cfg.data.object, store, "skip", **options)
    report = check_dataset(
        reader,
        store,
        limit=cfg.max_frames,
        out=job.folder,
        progress=cfg.console != JSON,
        seed=cfg.seed,
    )
    if cfg.console != JSON:
        print(format_report(report))
    file, pictures = job.folder / "data_report.json", job.folder / "contact_sheet.png"
    files = {"report": file} | ({"pictures": pictures} if pictures.is_file() else {})
    following = []
    if not report["problems"]:
        images = Counter(record.object for record in reader.records())
        names = (row["object"] for row in report["objects"])
        following = [train_on(job, name, images[name]) for name in names]
    ended(cfg.console, "checked", files, following, **report)
    if report["problems"]:
        many = len(report["problems"])
        raise ProblemsFound(f"{cfg.data.root}: {many} problem{'s' * (many != 1)}; see {file}")


def train_on(job: Job, name: str, images: int) -> str:
    """Return the command that trains on an object of the data, read as the check has read them.

    Args:
        job: The check.
        name: The object.
        images: How many images show it.
    """
    data = job.cfg.data
    options = [one for one in job.overrides if re.match(r"[+~]*data\.options\b", one)]
    # what train.py takes by default
    rendered = data.source == "fat" and (Path(data.root) / GENERATOR).is_file() and not options
    more: dict[str, Any] = {} if rendered else {"data": job.choices.get("data", data.source)}
    more |= {"data__root": data.root, "data__object": name, "data__meshes": data.meshes}
    if data.mesh_scale is not None:
        more["data__mesh_scale"] = data.mesh_scale
    if images < _FEW_IMAGES:  # the one image of a part may show little of the object
        more["data__min_visibility"] = 0.0
    return " ".join([typed("train", **more), *map(shlex.quote, options)])
