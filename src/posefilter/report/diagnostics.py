"""Signs of failure: which of a run's numbers say that something is wrong, and what that something is."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from posefilter.report.events import Curve
from posefilter.report.gather import Run


class Diagnostic(NamedTuple):
    """A number that tells of a failure when it is beyond its limit."""

    key: str  # of `numbers`
    label: str
    limit: float
    above: bool  # whether it is too much that is bad
    meaning: str  # what a number beyond the limit says


class Finding(NamedTuple):
    """A sign of one run."""

    sign: Diagnostic
    value: float
    bad: bool


DIAGNOSTICS = (
    Diagnostic("missed_share", "images without an estimate", 0.0, True, "The filter gave no finite pose."),
    Diagnostic(
        "belief/truth_outscored_by_wrong",
        "images in which a wrong pose outscores the truth",
        0.02,
        True,
        "The likelihood prefers a wrong pose: no amount of searching would help.",
    ),
    Diagnostic(
        "belief/coverage_90", "truths within the belief's 90 % region [%]", 75.0, False, "The belief is too sure of itself."
    ),
    Diagnostic("signs/pairwise_cosine", "agreement of the displacements", 0.8, True, "All particles move in one direction."),
    Diagnostic(
        "signs/offset_r2", "true offsets explained (R²)", 0.1, False, "Displacements say no more than their mean would."
    ),
    Diagnostic(
        "signs/heading", "cosine of displacement and true offset", 0.2, False, "Particles do not head for the object."
    ),
    Diagnostic("signs/auroc", "AUROC of the likelihood", 0.7, False, "The likelihood hardly tells object from background."),
    Diagnostic("signs/off_frame/last", "particles off the frame at the end", 0.1, True, "Particles drift out of the image."),
    Diagnostic(
        "signs/near_edge/last", "particles at an edge at the end", 0.4, True, "Particles gather at the image's edges."
    ),
    Diagnostic(
        "signs/near_corner/last", "particles in a corner at the end", 0.2, True, "Particles gather in the image's corners."
    ),
    Diagnostic("particles_on_object", "particles on the object at the end", 0.2, False, "Few particles find the object."),
    Diagnostic("fallen", "validation score lost since its best", 5.0, True, "Training went past its best: see the curves."),
    Diagnostic("not_finite", "training scalars that are no numbers", 0.0, True, "The training diverged."),
)


def diagnose(run: Run) -> list[Finding]:
    """Return the signs that a run tells of, the bad ones first."""
    known = collect_numbers(run)
    found = [
        Finding(sign, known[sign.key], (known[sign.key] > sign.limit) if sign.above else (known[sign.key] < sign.limit))
        for sign in DIAGNOSTICS
        if sign.key in known
    ]
    return sorted(found, key=lambda finding: not finding.bad)


def collect_numbers(run: Run) -> dict[str, float]:
    """Return a run's numbers by joined names: of its test, or of its last validation where there is none."""
    out = flatten(run.metrics) if run.metrics else read_last_validation(run.curves)[1]
    for name, values in (run.metrics.get("signs") or {}).items():
        if isinstance(values, list) and values:
            out[f"signs/{name}/last"] = float(values[-1])
    if out.get("instances"):
        out["missed_share"] = out.get("missed", 0.0) / out["instances"]
    score = run.curves.get("val/score")
    if score and len(score.values) > 1:
        out["fallen"] = max(score.values) - score.values[-1]
    training = [curve for tag, curve in run.curves.items() if tag.startswith("train/")]
    if training:
        out["not_finite"] = float(sum(not math.isfinite(x) for curve in training for x in curve.values))
    return {name: value for name, value in out.items() if math.isfinite(value)}


def read_last_validation(curves: Mapping[str, Curve]) -> tuple[int | None, dict[str, float]]:
    """Return the step and the numbers of the last validation; None and nothing before the first."""
    own = {tag.removeprefix("val/"): curve for tag, curve in curves.items() if tag.startswith(("val/", "signs/"))}
    if not own:
        return None, {}
    return max(curve.steps[-1] for curve in own.values()), {name: curve.values[-1] for name, curve in own.items()}


def flatten(content: Mapping[str, Any], prefix: str = "") -> dict[str, float]:
    """Return nested numbers under joined names; what is no number is left out."""
    out: dict[str, float] = {}
    for name, value in content.items():
        if isinstance(value, Mapping):
            out |= flatten(value, f"{prefix}{name}/")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            out[prefix + name] = float(value)
    return out


def collect_timings(run: Run) -> list[tuple[str, str]]:
    """Return how long things took, in words."""
    train = run.curves.get("train/total")
    out = []
    if train and len(train.steps) > 1:
        pace = sorted(
            (b - a) / (t - s)
            for a, b, s, t in zip(train.steps, train.steps[1:], train.times, train.times[1:], strict=False)
            if t > s and b > a
        )
        if pace:
            out.append(("training steps a second (median)", f"{pace[len(pace) // 2]:.2f}"))
        out.append(("training, validations included", format_duration(train.times[-1] - train.times[0])))
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
