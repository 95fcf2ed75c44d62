"""Choose what of a run's scalars is drawn, and how."""

import re
from collections.abc import Mapping, Sequence

from posefilter.metrics.registry import find_metric
from posefilter.report.charts import Line, Panel
from posefilter.report.events import Curve

# a chart's title, and the logged scalars that it shows; drawn where one of them was logged
VALIDATION = {
    "Area under the curve": ("val/add/auc", "val/add_s/auc"),
    "Recall": ("val/add/recall_01d", "val/add/recall_2cm"),
    "Median error": ("val/add/median_mm", "val/add_s/median_mm"),
    "Box IoU": ("val/iou",),
    "Particles on the object": ("val/particles_on_object",),
}
BELIEF = {
    "Belief near the truth": ("val/belief/mass_01d", "val/belief/mass_2cm"),
    "Coverage of the mean-distance regions": (
        "val/belief/distance_coverage_50", "val/belief/distance_coverage_90",
    ),
    "Truth outscored": ("val/belief/truth_outscored", "val/belief/truth_outscored_by_wrong"),
    "Effective sample size": ("val/belief/effective_particles",),
    "Spread of the centers": ("val/belief/spread_m",),
    "Spread of the rotations": ("val/belief/spread_rad",),
}  # fmt: skip
SIGNS = {
    "Where particles end": (
        "diagnostics/on_object/last", "diagnostics/off_frame/last", "diagnostics/near_edge/last",
        "diagnostics/near_corner/last", "diagnostics/first_axis_share/last",
    ),
    "Displacements": (
        "val/diagnostics/pairwise_cosine", "val/diagnostics/offset_r2",
        "val/diagnostics/offset_cosine",
    ),
    "Likelihood": ("val/diagnostics/auroc",),
}  # fmt: skip


def choose_panels(curves: Mapping[str, Curve], charts: Mapping[str, Sequence[str]]) -> list[Panel]:
    """Return the charts over the training's steps for which there is something logged."""
    out = []
    for title, keys in charts.items():
        infos = {key: find_metric(key) for key in keys if key in curves}
        lines = [
            Line(
                info.short or info.label,
                curves[key].steps,
                [info.convert(value) for value in curves[key].values],
            )
            for key, info in infos.items()
        ]
        if lines:
            first = next(iter(infos.values()))
            out.append(Panel(title, "training step", first.unit, lines, first.limits))
    return out


def make_training_panels(curves: Mapping[str, Curve]) -> list[Panel]:
    """Return the charts of the training: losses together, what has a unit and the learning rate
    alone.
    """
    rate = [tag for tag in curves if tag.startswith("lr-") or tag == "train/learning_rate"]
    own = {
        tag[6:]: curve
        for tag, curve in curves.items()
        if tag.startswith("train/") and tag not in rate
    }
    units = {
        name: name.rpartition("_")[2] for name in own if name.endswith(("_mm", "_px", "_m", "_rad"))
    }
    names = [name for name in sorted(own, key=lambda name: name != "loss") if name not in units]
    if len(names) == 2:  # the sum of one term is that term
        names = names[:1]
    losses = [
        Line(name.removeprefix("loss_").replace("_", " "), own[name].steps, own[name].values)
        for name in names
    ]
    out = [Panel("Training loss", "training step", "", losses)] if losses else []
    for name, unit in units.items():
        line = Line(name, own[name].steps, own[name].values)
        title = name.removesuffix(f"_{unit}").replace("_", " ").capitalize()
        out.append(Panel(title, "training step", unit, [line]))
    if rate:
        newest = max((curves[tag] for tag in rate), key=lambda curve: curve.times[-1])
        line = Line("learning rate", newest.steps, newest.values)
        out.append(Panel("Learning rate", "training step", "", [line]))
    return out


def make_health_panels(curves: Mapping[str, Curve]) -> list[Panel]:
    """Return the charts of the filter's iterations at the last validation, from
    `filter/<quantity>/step_<iteration>`.
    """
    found: dict[str, dict[int, float]] = {}
    for tag, curve in curves.items():
        match = re.fullmatch(r"filter/(\w+)/step_(\d{1,9})", tag)
        if match:
            found.setdefault(match[1], {})[int(match[2])] = curve.values[-1]
    out = []
    for name, values in found.items():
        info, steps = find_metric(f"filter/{name}"), sorted(values)
        line = Line(info.label, steps, [info.convert(values[step]) for step in steps])
        out.append(Panel(info.label.capitalize(), "iteration", info.unit, [line], info.limits))
    return out
