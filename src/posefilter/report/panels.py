"""Choose what of a run's scalars is drawn, and how."""

import re
from collections.abc import Mapping, Sequence

from posefilter.report.charts import Line, Panel
from posefilter.report.events import Curve

PERCENT, SHARE = (-3.0, 103.0), (-0.03, 1.03)
# title, unit, limits, factor, {tag: label}; drawn where one of the tags was logged
VALIDATION = (
    ("Area under the curve", "", PERCENT, 1.0, {"val/add/auc": "ADD", "val/add_s/auc": "ADD-S"}),
    ("Recall, ADD", "%", PERCENT, 1.0, {"val/add/recall_01d": "0.1 diameter", "val/add/recall_2cm": "2 cm"}),
    ("Median error", "mm", None, 1.0, {"val/add/median_mm": "ADD", "val/add_s/median_mm": "ADD-S"}),
    (
        "On the object",
        "",
        SHARE,
        1.0,
        {"val/iou": "box IoU", "val/particles_on_object": "share of particles"},
    ),
)
BELIEF = (
    ("Belief near the truth", "", SHARE, 1.0, {"val/belief/mass_01d": "0.1 diameter", "val/belief/mass_2cm": "2 cm"}),
    ("Coverage", "%", PERCENT, 1.0, {"val/belief/coverage_50": "50 % region", "val/belief/coverage_90": "90 % region"}),
    (
        "Truth outscored",
        "share of images",
        SHARE,
        1.0,
        {"val/belief/truth_outscored": "by any pose", "val/belief/truth_outscored_by_wrong": "by a wrong one"},
    ),
    ("Effective particles", "", None, 1.0, {"val/belief/effective_particles": "1 / Σw²"}),
    ("Spread of the centers", "mm", None, 1000.0, {"val/belief/spread_m": "weighted rms"}),
    ("Spread of the rotations", "degrees", None, 57.29578, {"val/belief/spread_rad": "weighted rms"}),
)
SIGNS = (
    (
        "Where particles end",
        "share",
        SHARE,
        1.0,
        {
            "signs/on_object/last": "on the object",
            "signs/off_frame/last": "off the frame",
            "signs/near_edge/last": "at an edge",
            "signs/near_corner/last": "in a corner",
        },
    ),
    (
        "Displacements",
        "",
        (-1.05, 1.05),
        1.0,
        {"val/signs/pairwise_cosine": "agreement", "val/signs/offset_r2": "R²", "val/signs/heading": "heading"},
    ),
    ("Likelihood, AUROC", "", SHARE, 1.0, {"val/signs/auroc": "AUROC"}),
)
HEALTH = {  # quantity: title, unit, factor, limits
    "ess": ("Effective particles", "share of all", 1.0, SHARE),
    "spread_m": ("Spread of the centers", "mm", 1000.0, None),
    "spread_rad": ("Spread of the rotations", "degrees", 57.29578, None),
    "spread_px": ("Spread", "px", 1.0, None),
    "sigma_m": ("Noise level", "mm", 1000.0, None),
    "sigma_px": ("Noise level", "px", 1.0, None),
    "best_log_likelihood": ("Best log-likelihood", "nat", 1.0, None),
}
Choice = tuple[str, str, tuple[float, float] | None, float, dict[str, str]]


def choose_panels(curves: Mapping[str, Curve], choices: Sequence[Choice]) -> list[Panel]:
    """Return the charts over the training's steps for which there is something logged."""
    out = []
    for title, unit, limits, factor, tags in choices:
        lines = [
            Line(label, curves[tag].steps, scale_curve(curves[tag], factor)) for tag, label in tags.items() if tag in curves
        ]
        if lines:
            out.append(Panel(title, "training step", unit, lines, limits))
    return out


def make_training_panels(curves: Mapping[str, Curve]) -> list[Panel]:
    """Return the charts of the training: losses together, what has a unit and the learning rate alone."""
    rate = [tag for tag in curves if tag.startswith("lr-") or tag == "train/learning_rate"]
    own = {tag[6:]: curve for tag, curve in curves.items() if tag.startswith("train/") and tag not in rate}
    units = {name: name.rpartition("_")[2] for name in own if name.endswith(("_mm", "_px", "_m", "_rad"))}
    names = [name for name in sorted(own, key=lambda name: name != "total") if name not in units]
    if len(names) == 2:  # the total of one loss is that loss
        names = names[:1]
    losses = [Line(name.replace("_", " "), own[name].steps, own[name].values) for name in names]
    out = [Panel("Training loss", "training step", "", losses)] if losses else []
    for name, unit in units.items():
        line = Line(name, own[name].steps, own[name].values)
        out.append(Panel(name.removesuffix(f"_{unit}").replace("_", " ").capitalize(), "training step", unit, [line]))
    if rate:
        newest = max((curves[tag] for tag in rate), key=lambda curve: curve.times[-1])
        line = Line("learning rate", newest.steps, newest.values)
        out.append(Panel("Learning rate", "training step", "", [line]))
    return out


def make_health_panels(curves: Mapping[str, Curve]) -> list[Panel]:
    """Return the charts of the filter's iterations at the last validation, from `filter/<quantity>/step_<iteration>`."""
    found: dict[str, dict[int, float]] = {}
    for tag, curve in curves.items():
        match = re.fullmatch(r"filter/(\w+)/step_(\d+)", tag)
        if match:
            found.setdefault(match[1], {})[int(match[2])] = curve.values[-1]
    out = []
    for name, values in found.items():
        title, unit, factor, limits = HEALTH.get(name, (name.replace("_", " ").capitalize(), "", 1.0, None))
        steps = sorted(values)
        out.append(Panel(title, "iteration", unit, [Line(name, steps, [factor * values[step] for step in steps])], limits))
    return out


def scale_curve(curve: Curve, factor: float) -> list[float]:
    """Return a curve's values in another unit."""
    return [factor * value for value in curve.values]
