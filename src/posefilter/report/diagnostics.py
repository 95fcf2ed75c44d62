"""Diagnostics: which of a run's numbers say that something is wrong, and what that something is."""

import math
from collections.abc import Mapping
from itertools import pairwise
from statistics import median_high
from typing import Any, NamedTuple

from posefilter.metrics.registry import MetricInfo, find_metric, read_number, rename_key
from posefilter.metrics.results import flatten
from posefilter.report.events import Curve
from posefilter.report.gather import Run


class Diagnostic(NamedTuple):
    """A number that tells of a failure when it is beyond its limit, on the side that is worse."""

    key: str  # of `collect_numbers`
    limit: float  # as stored
    meaning: str  # what a number beyond the limit says

    @property
    def info(self) -> MetricInfo:
        """Return how the number is called and written."""
        return find_metric(self.key)

    def is_bad(self, value: float) -> bool:
        """Tell whether a number is beyond the limit."""
        return self.info.direction * (value - self.limit) < 0


class Finding(NamedTuple):
    """A diagnostic of one run."""

    diagnostic: Diagnostic
    value: float
    bad: bool


DIAGNOSTICS = (
    Diagnostic("missed_fraction", 0.0, "The filter gave no finite pose."),
    Diagnostic("belief/truth_outscored_by_wrong", 0.02,
        "The likelihood prefers a wrong pose: no amount of searching would help."),
    Diagnostic("belief/distance_coverage_90", 75.0, "Estimates are wrong, or beliefs too narrow."),
    Diagnostic("credibility/coverage_90", 80.0,
        "Credible sets miss the truth: estimates are wrong, or beliefs too narrow."),
    Diagnostic("diagnostics/pairwise_cosine", 0.8, "All particles move in one direction."),
    Diagnostic("diagnostics/offset_r2", 0.1, "Displacements say no more than their mean would."),
    Diagnostic("diagnostics/offset_cosine", 0.2, "Particles do not head for the object."),
    Diagnostic("diagnostics/auroc", 0.7, "The likelihood hardly tells object from background."),
    Diagnostic("diagnostics/off_frame/last", 0.1, "Particles drift out of the image."),
    Diagnostic("diagnostics/near_edge/last", 0.4, "Particles gather at the image's edges."),
    Diagnostic("diagnostics/near_corner/last", 0.2, "Particles gather in the image's corners."),
    Diagnostic("particles_on_object", 0.2, "Few particles find the object."),
    Diagnostic("val_score_drop", 5.0, "Training went past its best: see the curves."),
    Diagnostic("not_finite", 0.0, "The training diverged."),
)  # fmt: skip


def diagnose(run: Run) -> list[Finding]:
    """Return the diagnostics that a run has numbers for, the bad ones first."""
    known = collect_numbers(run)
    plain, best = (known.get(f"{name}/auc", 0.0) for name in ("add", "add_up_to_symmetry"))
    if best > plain:  # it knows no symmetries, and a pose that is right up to one is far away by it
        known.pop("belief/distance_coverage_90", None)
    own = [(one, known[one.key]) for one in DIAGNOSTICS if one.key in known]
    found = [Finding(one, value, one.is_bad(value)) for one, value in own]
    return sorted(found, key=lambda finding: not finding.bad)


def collect_numbers(run: Run) -> dict[str, float]:
    """Return a run's numbers by joined names: of its test, or of its last validation where there is
    none.
    """
    out = list_numbers(run.metrics) if run.metrics else read_last_validation(run.curves)[1]
    for name in run.metrics.get("diagnostics") or {}:
        last = rename_key(f"diagnostics/{name}/last")
        if (value := read_number(run.metrics, last)) is not None:
            out[last] = value
    if out.get("instances"):
        out["missed_fraction"] = out.get("missed", 0.0) / out["instances"]
    score = run.curves.get("val/score")
    if score and len(score.values) > 1:
        out["val_score_drop"] = max(score.values) - score.values[-1]
    training = [curve for tag, curve in run.curves.items() if tag.startswith("train/")]
    if training:
        values = (x for curve in training for x in curve.values)
        out["not_finite"] = float(sum(not math.isfinite(x) for x in values))
    return {name: value for name, value in out.items() if math.isfinite(value)}


def read_last_validation(curves: Mapping[str, Curve]) -> tuple[int | None, dict[str, float]]:
    """Return the step and the numbers of the last validation; None and nothing before the first."""
    own = {tag: one for tag, one in curves.items() if tag.startswith(("val/", "diagnostics/"))}
    step = max((curve.steps[-1] for curve in own.values()), default=None)
    return step, {tag.removeprefix("val/"): curve.values[-1] for tag, curve in own.items()}


def list_numbers(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Return the numbers of a metrics.json by joined names, those of today."""
    return {rename_key(name): value for name, value in flatten(metrics).items()}


def collect_timings(run: Run) -> list[tuple[str, str]]:
    """Return how long things took, in words."""
    train = run.curves.get("train/loss")
    out = []
    if train and len(train.steps) > 1:
        logged = pairwise(zip(train.steps, train.times, strict=True))
        pace = [(b - a) / (t - s) for (a, s), (b, t) in logged if t > s and b > a]
        if pace:
            out.append(("training steps a second (median)", f"{median_high(pace):.2f}"))
        # a run that went on later did not train in between
        gaps = [
            b - max(a, *(s for s in run.starts if a < s <= b), a) for a, b in pairwise(train.times)
        ]
        out.append(("training, validations included", format_duration(sum(gaps))))
    if seconds := collect_numbers(run).get("seconds_per_image"):
        out.append(("filter, an image", f"{seconds:.3f} s"))
    return out


def format_duration(seconds: float) -> str:
    """Return seconds in words, two units at most."""
    whole = round(seconds)
    hours, minutes = whole // 3600, whole % 3600 // 60
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {whole % 60} s" if minutes else f"{whole} s"
