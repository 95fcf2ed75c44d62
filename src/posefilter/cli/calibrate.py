"""Calibrate a checkpoint: the probability that the object is there and its pose right, learned from
frames with the object and without.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from posefilter.cli.build import build_data
from posefilter.cli.checkpoints import find_checkpoint, method_of, read_checkpoint
from posefilter.cli.components import changes
from posefilter.cli.console import JSON, ended, show_table, typed, typed_prediction
from posefilter.cli.evaluate import data_settings
from posefilter.cli.files import save_whole
from posefilter.cli.job import Job
from posefilter.cli.machine import settle
from posefilter.confidence.calibration import Assessment, Calibration
from posefilter.confidence.fit import (
    FEWEST,
    Frames,
    cross_validate,
    fit_calibration,
    fit_choice,
    make_frames,
)
from posefilter.confidence.tolerance import PoseErrors, measure_pose_errors
from posefilter.confidence.verdicts import Costs, score_verdicts
from posefilter.data.absent import hide_annotation
from posefilter.data.dataset import FrameDataset
from posefilter.data.loaders import make_loader
from posefilter.errors import UserError
from posefilter.locks import hold
from posefilter.metrics.confidence import Confidence
from posefilter.metrics.credibility import score_truth
from posefilter.metrics.registry import find_metric
from posefilter.models.base import PoseEstimator
from posefilter.progress import watched
from posefilter.types import Batch

_BATCH = 8  # images
_SHOWN = ("auroc", "auroc_presence", "ece", "brier", "found", "false_alarms")


def calibrate(job: Job) -> None:
    """Write the calibration into the checkpoint, or into a copy of it."""
    cfg = job.cfg
    settle(cfg.threads, cfg.seed)
    if changes(cfg):
        raise UserError(
            "filter: a calibration belongs to the filter as the checkpoint has it; export.py "
            "writes a checkpoint with another"
        )
    file = find_checkpoint(cfg.checkpoint)
    out = file if cfg.out is None else Path(str(cfg.out))
    if out.exists():  # a training that still runs may write a better one meanwhile, which is kept
        hold(file.parent.parent if file.parent.name == "checkpoints" else file.parent)
    checkpoint = read_checkpoint(cfg.checkpoint)
    check_out(checkpoint, file, out, cfg.overwrite)
    method = method_of(checkpoint, lightning=False)
    name = method.object_model.name
    if "pose" not in method.capabilities:
        raise UserError(
            f"checkpoint={cfg.checkpoint}: {type(method).__name__} detects {name}, and estimates "
            "no pose that could be right"
        )
    method.to("cuda" if torch.cuda.is_available() else "cpu").seed = cfg.seed
    settings = data_settings(job, checkpoint["recipe"]["settings"], name, "val")
    settings.limit_val = cfg.frames
    data = build_data(settings, cfg.console)
    data.setup("validate")
    absent = [data.absent_dataset("val", cfg.frames)]
    if cfg.absent is not None and len(absent[0]) < cfg.frames:
        settings.root, settings.split = str(cfg.absent), {"val": 1.0}
        more = cfg.frames - len(absent[0])
        absent.append(build_data(settings, cfg.console).absent_dataset("val", more))
    if sum(map(len, absent)) < FEWEST:
        raise UserError(
            f"{data.root}: {sum(map(len, absent))} frames of its validation scenes lack {name}, "
            f"and {FEWEST} are needed; render some, and name their folder: absent=DIR ("
            f"{typed('generate', out='DIR', object=name, absent_fraction=1, frames=60)} meshes=...)"
        )
    shown = cfg.console != JSON
    calibration = learn(method, [data.val_dataset], absent, data.source, shown)
    save_whole({**checkpoint, "calibration": calibration.to_plain()}, out)
    tell(job, method, calibration, out)


def check_out(checkpoint: dict[str, Any], file: Path, out: Path, replace: bool) -> None:
    """Raise UserError where the calibration cannot be written without overwriting something."""
    if out.suffix != ".ckpt":
        raise UserError(f"out={out}: must end in .ckpt")
    same = out.exists() and out.samefile(file)
    if out.exists() and not same:
        raise UserError(f"out={out}: already exists")
    if same and checkpoint.get("calibration") is not None and not replace:
        raise UserError(f"{file}: is calibrated already; overwrite=true calibrates it anew")


def collect_frames(
    method: PoseEstimator,
    present: Sequence[FrameDataset],
    absent: Sequence[FrameDataset],
    shown: bool = False,
) -> Frames:
    """Run a filter on frames with the object and without, and return what speaks for each
    estimate, and how far it is off.

    Args:
        method: A method with its weights.
        present: Frames with the object.
        absent: Frames without.
        shown: Draw a bar.
    """
    values, there, errors, scores = [], [], [], []
    parts = [(one, True) for one in present] + [(one, False) for one in absent]
    batches = [
        (batch, is_there) for one, is_there in parts for batch in make_loader(one, _BATCH, 0)
    ]
    for number, (batch, is_there) in enumerate(watched(batches, "estimating", shown)):
        truth = batch.camera_from_object
        seen = Batch(*(x.to(method.device) for x in hide_annotation(batch)))
        with torch.no_grad():
            trace = method.predict_step(seen, number)
            values.append(method.collect_features(trace, seen))
        there.append(np.full(len(truth), is_there))
        nothing = np.full(len(truth), np.nan)
        off, surprise = PoseErrors(*[nothing] * 4), nothing
        if is_there:
            measured = measure_pose_errors(trace.belief.best.cpu(), truth, method.object_model)
            off = PoseErrors(*(part.double().numpy() for part in measured))
            surprise = score_truth(trace.belief, truth, method.object_model).nonconformity.numpy()
        errors.append(off)
        scores.append(surprise)
    return make_frames(values, there, errors, scores)


def learn(
    method: PoseEstimator,
    present: Sequence[FrameDataset],
    absent: Sequence[FrameDataset],
    source: str,
    shown: bool = False,
) -> Calibration:
    """Return the calibration of a method, with its quality on held-out parts of the frames.

    Frames are searched twice: first answers teach what answers are compared by; the answers that
    are then chosen teach the probabilities.

    Args:
        method: A method with its weights; its calibration is replaced.
        present: Frames with the object.
        absent: Frames without.
        source: The kind of data that they are of.
        shown: Draw bars.
    """
    method.calibration, first = None, None
    frames = collect_frames(method, present, absent, shown)
    if method.filter.max_searches > 1:
        method.calibration = first = fit_choice(frames, source)
        frames = collect_frames(method, present, absent, shown)
    held = measure_quality(frames, cross_validate(frames, first=first))
    quality = {key: float(held[key]) for key in _SHOWN if math.isfinite(held[key])}
    return fit_calibration(frames, source, quality, first)


def measure_quality(frames: Frames, found: Assessment) -> dict[str, Any]:
    """Return the numbers of `Confidence` for probabilities of frames, at the default costs."""
    metric = Confidence()
    there, right = torch.from_numpy(frames.present), torch.from_numpy(frames.correct)
    verdicts = score_verdicts(found, Costs())
    metric.update(found.presence, found.probability, there, right, verdicts)
    quality: dict[str, Any] = metric.compute()
    return quality


def tell(job: Job, method: PoseEstimator, calibration: Calibration, out: Path) -> None:
    """Say what was learned, from what, and how good it is."""
    counts, quality = calibration.counts, calibration.quality
    rows = [
        ("frames with the object", str(counts["right"] + counts["wrong"])),
        ("of these, the pose is right", str(counts["right"])),
        ("frames without", str(counts["absent"])),
    ]
    if calibration.conformal is not None:
        shown = " and ".join(str(len(own)) for own in calibration.conformal.scores)
        rows.append(("groups of those with it, by rising probability", shown))
    infos = {key: find_metric(f"confidence/{key}") for key in _SHOWN if key in quality}
    rows += [(info.label, info.describe(quality[key])) for key, info in infos.items()]
    title = f"{method.object_model.name}: held-out parts of the calibration frames"
    show_table(job.cfg.console, title, rows)
    following = [typed_prediction(out)]
    content = {"object": method.object_model.name, "counts": dict(counts), "quality": dict(quality)}
    ended(job.cfg.console, "calibrated", {"weights": out}, following, **content)
