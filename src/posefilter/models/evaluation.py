"""What validation and test keep of a method's results: which metrics, and what each is given."""

from collections.abc import Set
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from posefilter.confidence.blank import find_blank
from posefilter.confidence.calibration import Assessment
from posefilter.confidence.scale_ratio import ScaleRatio
from posefilter.confidence.tolerance import measure_pose_errors
from posefilter.confidence.verdicts import Costs, score_verdicts
from posefilter.geometry.boxes import box_of_pose
from posefilter.types import Batch, BeliefBatch, ObjectModel, Trace

if TYPE_CHECKING:
    from posefilter.models.base import PoseEstimator


def make_metrics(object_model: ObjectModel, capabilities: Set[str]) -> dict[str, nn.Module]:
    """Create the metrics of an object, by name, for a method that has some capabilities."""
    # torchmetrics: prediction needs none
    from posefilter.metrics.bop import BopErrors
    from posefilter.metrics.collect import (
        BeliefQuality,
        BoxIoU,
        ErrorsByVisibility,
        ParticlesOnObject,
        PoseErrors,
    )
    from posefilter.metrics.confidence import Confidence
    from posefilter.metrics.credibility import Credibility
    from posefilter.metrics.parts import PartIoU
    from posefilter.metrics.scale_ratio import ScaleRatios

    metrics: dict[str, nn.Module] = {
        "iou": BoxIoU(),
        "particles_on_object": ParticlesOnObject(),
    }
    if "pose" in capabilities:
        metrics["poses"] = PoseErrors([object_model])
        metrics["bop"] = BopErrors([object_model])
        metrics["by_visibility"] = ErrorsByVisibility([object_model])
        metrics["belief"] = BeliefQuality(object_model)
        metrics["credibility"] = Credibility()
        metrics["confidence"] = Confidence()
        metrics["scale_ratio"] = ScaleRatios()
        if object_model.parts:
            metrics["parts"] = PartIoU(object_model)
    return metrics


def update_metrics(method: "PoseEstimator", trace: Trace, batch: Batch) -> BeliefBatch:
    """Add a batch's errors to a method's metrics.

    Args:
        method: The method.
        trace: A finished run of its filter.
        batch: The B images, with mask and pose.

    Returns:
        The beliefs that the metrics took in: calibrated, where the method is.
    """
    from posefilter.metrics.credibility import score_truth  # torchmetrics

    scores, object_model = method.scores, method.object_model
    height, width = batch.rgb.shape[-2:]
    best, truth = trace.belief.best, batch.camera_from_object
    true_box = box_of_pose(truth, object_model.hull, batch.intrinsics, height, width)
    scores["iou"].update(method.box(trace, batch), true_box)
    pixels = method.particle_pixels(trace.particles[-1], batch)
    scores["particles_on_object"].update(batch.mask, pixels)
    belief = trace.belief
    if "poses" in scores:
        scores["poses"].update(best, truth)
        scores["bop"].update(best, truth, batch.intrinsics, width)
        scores["by_visibility"].update(scores["poses"].last(), batch.visibility)
        assessment = judge_confidence(method, trace, batch, present=True)
        belief, _ = method.calibrate_belief(belief, assessment)
        scores["belief"].update(belief, truth)
        at_truth = score_truth(belief, truth, object_model)
        scores["credibility"].update(at_truth, batch.visibility)
    if "parts" in scores:
        scores["parts"].update(best, batch)
    return belief


def judge_confidence(
    method: "PoseEstimator", trace: Trace, batch: Batch, present: bool
) -> Assessment | None:
    """Add a batch's probabilities, where the method is calibrated, and scale ratios, where it can
    tell them, to its metrics; return the probabilities.

    Args:
        method: The method.
        trace: A finished run of its filter.
        batch: The B images.
        present: Whether the object is in them; if not, the batch's poses are not used.
    """
    count = len(batch.rgb)
    size = method.measure_scale_ratio(trace, batch)
    if present and "scale_ratio" in method.scores:
        unknown = torch.full((count,), torch.nan)
        columns = (unknown, unknown) if size is None else (size.scale, size.contradicts())
        method.scores["scale_ratio"].update(*columns)
    assessment = method.assess(trace, batch)
    if assessment is None:
        return None
    correct = torch.zeros(count, dtype=torch.bool)
    if present:
        truth = batch.camera_from_object
        errors = measure_pose_errors(trace.belief.best, truth, method.object_model)
        correct = method.pose_tolerance.accepts(errors)
    method.scores["confidence"].update(
        assessment.presence,
        assessment.probability,
        torch.full_like(correct, present),
        correct,
        choose_verdicts(assessment, method.costs, size, batch),
    )
    return assessment


def choose_verdicts(
    assessment: Assessment, costs: Costs, size: ScaleRatio | None, batch: Batch
) -> Tensor:
    """Return the verdicts as a result has them: 1 found, 0 unsure, -1 absent; (B,)."""
    verdict = score_verdicts(assessment, costs)
    if size is not None:  # of a wrong size none is found
        wrong = size.contradicts().to(verdict.device)
        verdict = torch.where(wrong, verdict.clamp_max(0), verdict)
    rgb, depth = batch.rgb.permute(0, 2, 3, 1).contiguous().cpu(), batch.depth[:, 0].cpu()
    images = zip(rgb.numpy(), depth.numpy(), strict=True)
    blank = torch.tensor([bool(find_blank(*image)) for image in images])
    return torch.where(blank.to(verdict.device), 0, verdict)


def last_assessment(method: "PoseEstimator", count: int) -> Assessment:
    """Return the probabilities of the batch that the metrics took in last, of `count` images; NaN
    where the method is not calibrated.
    """
    if method.calibration is None or "confidence" not in method.scores:
        return Assessment(*torch.full((2, count), torch.nan, dtype=torch.float64))
    judged = method.scores["confidence"].last()
    return Assessment(judged.presence, judged.probability)


def compute_metrics(method: "PoseEstimator") -> dict[str, Any]:
    """Return a method's metrics since their last reset, in the form of metrics.json."""
    scores = method.scores

    def compute(name: str) -> Any:
        return scores[name].compute() if name in scores else None

    out: dict[str, Any] = {"instances": 0, "missed": 0}
    out |= dict.fromkeys(("add", "add_s", "add_up_to_symmetry", "mssd", "mspd"))
    if "poses" in scores:
        out |= compute("poses") | compute("bop")
    else:
        out["instances"] = int(scores["iou"].count)
    for name in ("iou", "particles_on_object"):
        out[name] = float(compute(name))
    times = method.seconds_per_image
    out["seconds_per_image"] = sum(times) / len(times) if times else None
    out["belief"] = compute("belief")
    out["confidence"] = None if method.calibration is None else compute("confidence")
    if out["confidence"] is not None:
        out["confidence"]["pose_tolerance"] = method.pose_tolerance.describe()
    for name in ("credibility", "by_visibility", "scale_ratio", "parts"):
        out[name] = compute(name)
    return out
