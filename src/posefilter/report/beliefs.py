"""Charts and tables that tell whether a belief means what it says."""

from collections.abc import Mapping
from typing import Any

from posefilter.metrics.registry import PERCENT
from posefilter.report.blocks import Block, Cell, Heading, Paragraph, Table, draw_charts
from posefilter.report.charts import Line, Panel

_DIAGONAL = (0.0, 100.0)
_TABLED = (0.5, 0.8, 0.9, 0.95)


def show_calibration(metrics: Mapping[str, Any]) -> list[Block]:
    """Return the coverage of credible sets and the reliability of the probability, as charts and
    tables; what a metrics.json lacks is left out.
    """
    panels = [*chart_coverage(metrics), *chart_reliability(metrics)]
    if not panels:
        return []
    text = "On the diagonal, beliefs are calibrated; below it, wrong or too narrow."
    words: list[Block] = [Heading("Calibration"), Paragraph([text])]
    return [*words, *draw_charts(panels), *list_coverage(metrics), *list_reliability(metrics)]


def chart_coverage(metrics: Mapping[str, Any]) -> list[Panel]:
    """Return the chart of how often credible sets hold the truth, at every level."""
    found = metrics.get("credibility") or {}
    levels = [100 * level for level in found.get("levels") or ()]
    lines = []
    for label, _, shares in _list_groups(metrics):
        name = label if label == "all" else f"visible share {label}"
        covered = [0.0, *(100 * share for share in shares), 100.0]
        lines.append(Line(name, [0.0, *levels, 100.0], covered))
    title = "Truths in the credible set"
    if not lines:
        return []
    return [Panel(title, "level of the set [%]", "%", lines, PERCENT, diagonal=_DIAGONAL)]


def chart_reliability(metrics: Mapping[str, Any]) -> list[Panel]:
    """Return the reliability diagram: how often poses of a probability are right."""
    bins = (metrics.get("confidence") or {}).get("bins") or []
    if not bins:
        return []
    said, right = ([100 * one[key] for one in bins] for key in ("probability", "right"))
    line = Line("bins of a tenth", said, right)
    title = "Right poses by probability"
    return [Panel(title, "probability [%]", "%", [line], PERCENT, diagonal=_DIAGONAL)]


def list_coverage(metrics: Mapping[str, Any]) -> list[Block]:
    """Return the coverage of some levels, of all images and by visibility."""
    levels = (metrics.get("credibility") or {}).get("levels") or []
    places = [levels.index(level) for level in _TABLED if level in levels]
    rows: list[list[Cell]] = [
        [label, str(count), *(f"{100 * shares[place]:.0f}" for place in places)]
        for label, count, shares in _list_groups(metrics)
    ]
    head = ("visible share", "images", *(f"{100 * levels[place]:g} % set" for place in places))
    caption = Paragraph(["Truths in the credible set [%]:"])
    return [caption, Table(head, rows, numeric=range(1, len(head)))] if rows else []


def list_reliability(metrics: Mapping[str, Any]) -> list[Block]:
    """Return the bins of the reliability diagram."""
    bins = (metrics.get("confidence") or {}).get("bins") or []
    rows: list[list[Cell]] = [
        [
            f"{100 * one['from']:.0f} to {100 * one['to']:.0f}",
            str(one["frames"]),
            f"{100 * one['probability']:.0f}",
            f"{100 * one['right']:.0f}",
        ]
        for one in bins
    ]
    head = ("probability [%]", "frames", "mean [%]", "right [%]")
    caption = Paragraph(["Frames with the object and without, by the probability of their pose:"])
    return [caption, Table(head, rows, numeric=range(1, len(head)))] if rows else []


def _list_groups(metrics: Mapping[str, Any]) -> list[tuple[str, int, list[float]]]:
    """Return all images, then each quarter of visibility: its label, images, and coverages."""
    found = metrics.get("credibility") or {}
    if not found.get("levels"):
        return []
    groups = [("all", int(metrics.get("instances") or 0), list(found["all"]))]
    for one in found.get("quarters") or ():
        label = f"{one['from']:g} to {one['to']:g}"
        groups.append((label, one["instances"], list(one["coverage"])))
    return groups
