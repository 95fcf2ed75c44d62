"""Reduce a checkpoint to what prediction needs: weights, object, and recipe (with components
of the filter chosen anew, if wished); or write its networks for programs of others.
"""

import os
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from posefilter.cli.checkpoints import is_calibrated_filter, method_of, read_checkpoint
from posefilter.cli.components import changed, changes, chosen
from posefilter.cli.console import ended, typed_prediction, warn
from posefilter.cli.evaluate import OF_THE_CHECKPOINT
from posefilter.cli.files import pack_whole
from posefilter.cli.job import Job
from posefilter.errors import UserError
from posefilter.files import write_whole
from posefilter.models.quantization import pack, pack_object, unpack

_KEPT = ("state_dict", "recipe", "object_model", "calibration", "pytorch-lightning_version")


def export(job: Job) -> None:
    """Write the stripped checkpoint, which works wherever the whole one did, but for going on with
    training; or with `format=onnx|torch` the networks.
    """
    out = Path(str(job.cfg.out))
    if job.cfg.format != "weights":
        export_networks(job, out)
        return
    if out.suffix != ".ckpt":
        raise UserError(f"out={out}: must end in .ckpt")
    if os.path.lexists(out):  # it may be a training's own
        raise UserError(f"out={out}: already exists; choose another file, or remove it")
    stripped = strip(read_checkpoint(job.cfg.checkpoint), job.cfg.points, job.cfg.quantize)
    recipe = stripped["recipe"]
    before = recipe["settings"]
    recipe["settings"] = changed(before, changes(job.cfg))
    if not is_calibrated_filter(recipe["settings"], before) and stripped.pop("calibration", None):
        said = "the calibration is left out: it was made for another filter (calibrate.py)"
        warn(job.cfg.console, said, calibration="left out")
    recipe["choices"] = {**recipe["choices"], **chosen(job)}
    size = write_weights(stripped, out, job.cfg.max_mb)
    following = [typed_prediction(out)]
    ended(job.cfg.console, "exported", {"weights": out}, following, megabytes=size)


def export_networks(job: Job, out: Path) -> None:
    """Write the networks and the filter's settings into a folder.

    Raises:
        UserError: The folder holds other files, or the filter cannot be exported.
    """
    from posefilter.deploy.write import check_format, write_filter  # tracing: seldom asked for

    check_format(job.cfg.format)
    if out.suffix == ".ckpt" or (out.exists() and (not out.is_dir() or any(out.iterdir()))):
        raise UserError(f"out={out}: name a new folder, or an empty one, for the networks")
    checkpoint = read_checkpoint(job.cfg.checkpoint)
    method = method_of(checkpoint, changes(job.cfg), lightning=False)
    size = write_filter(method, out, job.cfg.width, job.cfg.height, job.cfg.format)
    ended(job.cfg.console, "exported", {"networks": out}, [], megabytes=size)


def write_weights(stripped: dict[str, Any], out: Path, max_mb: float) -> float:
    """Write a stripped checkpoint; return its size [MB].

    Raises:
        UserError: It could not be read again, or is larger than `max_mb`.
    """
    content = pack_whole(stripped)
    size = len(content) / 1e6
    if size > max_mb:
        raise UserError(f"out={out}: {size:.1f} MB, more than max_mb={max_mb}")
    with TemporaryDirectory() as folder:  # as whoever gets the file will read it
        copy = Path(folder) / out.name
        copy.write_bytes(content)
        method_of(read_checkpoint(copy), lightning=False)
    write_whole(out, content, sync=True)
    return size


def strip(checkpoint: dict[str, Any], points: int, quantize: bool = False) -> dict[str, Any]:
    """Return a checkpoint without optimizer, loops and callbacks, its object with so many surface
    points at most.

    quantize: kernels in 8 bits and the rest in 16, a quarter of the size
    (models/quantization.py); they are read back into 32.
    """
    kept = {key: checkpoint[key] for key in _KEPT if key in checkpoint}
    model, weights = dict(kept["object_model"]), unpack(kept["state_dict"])
    every = max(1, -(-len(model["points"]) // points))
    model["points"] = model["points"][::every].clone()
    settings = dict(kept["recipe"]["settings"])
    data = settings.get("data") or {}
    # no folders of the trainer's machine
    settings["data"] = {key: data[key] for key in OF_THE_CHECKPOINT if key in data}
    kept["recipe"] = {**kept["recipe"], "settings": settings}
    state = pack(weights) if quantize else {key: value.clone() for key, value in weights.items()}
    return {**kept, "state_dict": state, "object_model": pack_object(model) if quantize else model}
