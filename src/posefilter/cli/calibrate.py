"""Calibrate a checkpoint: the probability that the object is there and its pose right, learned from
frames with the object and without.
"""

import math
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from posefilter.cli.build import build_data
from posefilter.cli.checkpoints import find_checkpoint, method_of, read_checkpoint
from posefilter.cli.components import changes
from posefilter.cli.console import JSON, ended, say, show_table, typed, typed_prediction
from posefilter.cli.evaluate import check_own_folders, data_settings
from posefilter.cli.files import save_whole
from posefilter.cli.job import Job
from posefilter.cli.learned import warn_of_learned
from posefilter.cli.machine import settle
from posefilter.confidence.belief_scale import (
    FEWEST_RIGHT,
    BeliefScale,
    PoseSpread,
    calibrate_belief,
    fit_belief_scale,
    measure_spread,
)
from posefilter.confidence.calibration import Assessment, Calibration
from posefilter.confidence.conformal import LITTLE_VISIBLE, fit_conformal
from posefilter.confidence.fit import (
    FEWEST,
    Frames,
    cross_validate,
    fit_calibration,
    fit_choice,
    make_frames,
    standardize_frames,
)
from posefilter.confidence.second_look import look_again
from posefilter.confidence.tolerance import PoseErrors, measure_pose_errors
from posefilter.confidence.verdicts import Costs, score_verdicts
from posefilter.data.absent import hide_annotation
from posefilter.data.dataset import FrameDataset
from posefilter.data.loaders import make_loader
from posefilter.devices import choose_device
from posefilter.errors import UserError
from posefilter.filters.traces import keep_last_step
from posefilter.locks import hold
from posefilter.metrics.confidence import Confidence
from posefilter.metrics.credibility import score_truth
from posefilter.metrics.registry import find_metric
from posefilter.models.base import PoseEstimator
from posefilter.progress import watched
from posefilter.report.diagnostics import format_duration
from posefilter.types import Batch, BeliefBatch, ObjectModel, Trace

_BATCH = 8  # images
_PAUSE = 30.0  # between lines of progress [s]
_FOLDS = 5  # parts of the frames, each of whose beliefs the others calibrate
_Item = TypeVar("_Item")
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
    # of a link the file that it leads to: both names have the calibration then
    file = find_checkpoint(cfg.checkpoint).resolve()
    out = file if cfg.out is None else Path(str(cfg.out))
    if out.exists():  # a training that still runs may write a better one meanwhile, which is kept
        hold(file.parent.parent if file.parent.name == "checkpoints" else file.parent)
    checkpoint = read_checkpoint(cfg.checkpoint)
    check_out(checkpoint, file, out, cfg.overwrite or cfg.sets_only)
    method = method_of(checkpoint, lightning=False)
    if cfg.sets_only and method.calibration is None:
        raise UserError(
            f"sets_only: checkpoint={cfg.checkpoint} has no probability to group frames by; "
            "calibrate it first"
        )
    name = method.object_model.name
    if "pose" not in method.capabilities:
        raise UserError(
            f"checkpoint={cfg.checkpoint}: {type(method).__name__} detects {name}, and estimates "
            "no pose that could be right"
        )
    method.to(choose_device()).seed = cfg.seed
    settings = data_settings(job, checkpoint["recipe"]["settings"], name, "val")
    check_own_folders(settings, job)
    settings.limit_val = cfg.frames
    data = build_data(settings, cfg.console, job.overrides)
    data.setup("validate")
    warn_of_learned(str(file), data, cfg.console, "val")
    if len(data.val_dataset) < FEWEST:
        raise UserError(
            f"{data.root}: {len(data.val_dataset)} frames of its validation scenes show {name}, "
            f"and {FEWEST} are needed"
        )
    if cfg.sets_only:
        calibration = learn_sets(method, data.val_dataset, cfg.console)
        save_whole({**checkpoint, "calibration": calibration.to_plain()}, out)
        title = f"{name}: conformal sets"
        show_table(cfg.console, title, list_groups(calibration))
        ended(cfg.console, "calibrated", {"weights": out}, [typed_prediction(out)], object=name)
        return
    without = cfg.frames if cfg.absent_frames is None else cfg.absent_frames
    absent = [data.absent_dataset("val", without)]
    if cfg.absent is not None and len(absent[0]) < without:
        settings.root, settings.split = str(cfg.absent), {"val": 1.0}
        more = without - len(absent[0])
        absent.append(build_data(settings, cfg.console).absent_dataset("val", more))
    if sum(map(len, absent)) < FEWEST:
        raise UserError(
            f"{data.root}: {sum(map(len, absent))} frames of its validation scenes lack {name}, "
            f"and {FEWEST} are needed; render some, and name their folder: absent=DIR ("
            f"{typed('generate', out='DIR', object=name, absent_fraction=1, frames=60)} meshes=...)"
        )
    calibration = learn(method, data.val_dataset, absent, data.source, cfg.console)
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


class Beliefs(NamedTuple):
    """The beliefs of n frames that show the object, as the filter leaves them, and the truths."""

    beliefs: BeliefBatch
    truth: Tensor  # (n, 4, 4)

    def select(self, index: np.ndarray) -> "Beliefs":
        """Return some of the frames."""
        return Beliefs(BeliefBatch(*(part[index] for part in self.beliefs)), self.truth[index])


class FirstAnswers(NamedTuple):
    """The first answers to one batch of images."""

    trace: Trace  # its last step, without the encoded images
    draws: Tensor  # state of the generator that other searches go on with


def collect_frames(
    method: PoseEstimator,
    present: FrameDataset,
    absent: Sequence[FrameDataset],
    console: str,
    first_answers: Sequence[FirstAnswers] = (),
) -> tuple[Frames, Beliefs, list[FirstAnswers]]:
    """Run a filter on frames with the object and without, and return what speaks for each
    estimate, how far it is off, the beliefs of frames with the object, and the first answers.

    Args:
        method: A method with its weights; calibrated, it searches again where it doubts.
        present: Frames with the object.
        absent: Frames without.
        console: "rich" or "json".
        first_answers: Those of an earlier call with the same frames, which are not searched for
            again: estimates, and the draws of other searches, stay what they would be.
    """
    values, there, errors, visibility, beliefs, answers = [], [], [], [], [], []
    parts = (present, *absent)
    loaders = [make_loader(one, one.find_batch_size(_BATCH), 0) for one in parts]
    count = sum(map(len, loaders))
    # batch after batch: all of a thousand frames would take gigabytes
    batches = ((batch, loader is loaders[0]) for loader in loaders for batch in loader)
    for number, (batch, is_there) in enumerate(_report_progress(batches, count, console)):
        truth = batch.camera_from_object
        seen = Batch(*(x.to(method.device) for x in hide_annotation(batch)))
        with torch.no_grad():
            generator = method.generator("predict", number)
            if first_answers:
                answer = first_answers[number]
                generator.set_state(answer.draws)
                trace = answer.trace._replace(encoding=method.encode(seen))
            else:
                trace = method.search(seen, generator)
                last = keep_last_step(trace)._replace(encoding=None)  # the rest takes gigabytes
                answer = FirstAnswers(last, generator.get_state())
            answers.append(answer)
            trace = look_again(method, trace, seen, generator)
            values.append(method.collect_features(trace, seen))
        there.append(np.full(len(truth), is_there))
        unknown = np.full(len(truth), np.nan)
        off = PoseErrors(*[unknown] * 4)
        visibility.append(batch.visibility.double().numpy() if is_there else unknown)
        if is_there:
            measured = measure_pose_errors(trace.belief.best.cpu(), truth, method.object_model)
            off = PoseErrors(*(part.double().numpy() for part in measured))
            beliefs.append((*(part.cpu() for part in trace.belief), truth))
        errors.append(off)
    *own, truths = (torch.cat(parts) for parts in zip(*beliefs, strict=True))
    frames = make_frames(values, there, errors, visibility)
    return frames, Beliefs(BeliefBatch(*own), truths), answers


def _report_progress(items: Iterable[_Item], count: int, console: str) -> Iterator[_Item]:
    """Yield batches, `count` of them: on a terminal under a bar, else with a line now and then."""
    began = last = time.perf_counter()
    has_bar = console != JSON and sys.stdout.isatty()
    for done, item in enumerate(watched(items, count, "estimating", has_bar)):
        now = time.perf_counter()
        if done and now - last >= _PAUSE and not has_bar:
            last, left = now, format_duration((now - began) / done * (count - done))
            sentence = f"estimating: batch {done} of {count}, {left} left of this pass"
            say(console, "estimating", sentence, batch=done, batches=count)
        yield item


def learn(
    method: PoseEstimator,
    present: FrameDataset,
    absent: Sequence[FrameDataset],
    source: str,
    console: str,
) -> Calibration:
    """Return the calibration of a method, with its quality on held-out parts of the frames.

    First answers teach what answers are compared by; those that are then chosen, after other
    searches of images whose first answer is doubtful, teach the probabilities, and how wide a
    belief is.

    Args:
        method: A method with its weights; its calibration is replaced.
        present: Frames with the object.
        absent: Frames without.
        source: The kind of data that they are of.
        console: "rich" or "json".
    """
    method.calibration, first = None, None
    frames, beliefs, answers = collect_frames(method, present, absent, console)
    if method.filter.max_searches > 1:
        method.calibration = first = fit_choice(frames, source)
        frames, beliefs, _ = collect_frames(method, present, absent, console, answers)
    return fit_answers(frames, beliefs, first, method.object_model, source)


def learn_sets(method: PoseEstimator, present: FrameDataset, console: str) -> Calibration:
    """Return the calibration of a method with other conformal sets, learned from frames that it has
    not seen: their probabilities, and the widths of their beliefs, are then those that new frames
    get, as split conformal prediction supposes.

    Args:
        method: A calibrated method.
        present: Frames with the object, of none that the calibration is of.
        console: "rich" or "json".
    """
    calibration = method.calibration
    assert calibration is not None
    frames, (beliefs, truth), _ = collect_frames(method, present, [], console)
    columns = torch.from_numpy(frames.values.T)
    found = calibration.assess(dict(zip(frames.features, columns, strict=True)))
    beliefs, _ = method.calibrate_belief(beliefs, found)
    scores = score_truth(beliefs, truth, method.object_model).nonconformity.numpy()
    sets = fit_conformal(scores, found.probability.numpy(), frames.visibility)
    return replace(calibration, conformal=sets)


def fit_answers(
    frames: Frames,
    beliefs: Beliefs,
    first: Calibration | None,
    object_model: ObjectModel,
    source: str,
) -> Calibration:
    """Fit a calibration to the answers that were chosen.

    Args:
        frames: With the object and without.
        beliefs: Of those with it.
        first: What answers were compared by; None: each image has one answer.
        object_model: The object.
        source: The kind of data that the frames are of.
    """
    held = cross_validate(frames, first=first)
    scores = measure_quality(frames, held)
    quality = {key: float(scores[key]) for key in _SHOWN if math.isfinite(scores[key])}
    own = frames.present
    probability = held.probability[own]
    features = torch.from_numpy(standardize_frames(frames, first)[own])
    scale, nonconformity = fit_beliefs(
        beliefs, probability, features, frames.correct[own], object_model
    )
    fitted = fit_calibration(frames, source, quality, first)
    visibility = None if frames.visibility is None else frames.visibility[own]
    sets = fit_conformal(nonconformity, probability.numpy(), visibility)
    return replace(fitted, belief_scale=scale, conformal=sets)


def fit_beliefs(
    beliefs: Beliefs,
    probability: Tensor,
    features: Tensor,
    right: np.ndarray,
    object_model: ObjectModel,
) -> tuple[BeliefScale | None, np.ndarray]:
    """Return the scale of beliefs, and the nonconformity of the truths under calibrated beliefs.

    Args:
        beliefs: Of n frames.
        probability: (n,) of each, by a calibration that has not seen it.
        features: (n, F) of each, standardized.
        right: (n,) bool, whether the estimate is right.
        object_model: The object.

    Returns:
        The scale of all frames, None where too few are right; and (n,) [nat], of the beliefs as
        the filter leaves them where there is no scale. Each frame's belief is calibrated by a fit
        to the other folds, or to all where these have too few right estimates.
    """
    spread = measure_spread(*beliefs, object_model)

    def fit(index: np.ndarray) -> BeliefScale | None:
        index = index[right[index]]
        own = PoseSpread(*(x[index] for x in spread))
        return fit_belief_scale(own, probability[index], features[index])

    fold = np.random.default_rng(0).permutation(len(right)) % _FOLDS
    nonconformity = np.full(len(right), np.nan)
    whole = fit(np.arange(len(right)))
    for k in range(_FOLDS):
        held = np.flatnonzero(fold == k)
        if not len(held):
            continue
        own, truth = beliefs.select(held)
        scale = None if whole is None else fit(np.flatnonzero(fold != k)) or whole
        if scale is not None:
            own, _ = calibrate_belief(own, probability[held], features[held], scale, object_model)
        nonconformity[held] = score_truth(own, truth, object_model).nonconformity.numpy()
    return whole, nonconformity


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
    rows += list_groups(calibration)
    few = f"that of the particles: fewer than {FEWEST_RIGHT} estimates are right"
    width = f"learned from {counts['right']} right estimates"
    rows.append(("width of a belief", few if calibration.belief_scale is None else width))
    infos = {key: find_metric(f"confidence/{key}") for key in _SHOWN if key in quality}
    rows += [(info.label, info.describe(quality[key])) for key, info in infos.items()]
    title = f"{method.object_model.name}: held-out parts of the calibration frames"
    show_table(job.cfg.console, title, rows)
    following = [typed_prediction(out)]
    content = {"object": method.object_model.name, "counts": dict(counts), "quality": dict(quality)}
    ended(job.cfg.console, "calibrated", {"weights": out}, following, **content)


def list_groups(calibration: Calibration) -> list[tuple[str, str]]:
    """Return rows that tell how many frames each group of the conformal sets has."""
    sets = calibration.conformal
    if sets is None:
        return []
    parts = {"groups of those with it, by rising probability": sets.scores}
    if sets.occluded:
        parts[f"of these, visibility below {LITTLE_VISIBLE}"] = sets.occluded
    return [(name, " and ".join(str(len(own)) for own in part)) for name, part in parts.items()]
