"""Tables of a run's results."""

from collections.abc import Mapping
from typing import Any

from posefilter.metrics.registry import METRICS, find_metric, read_number
from posefilter.report.blocks import Block, Cell, Heading, Table, Text
from posefilter.report.diagnostics import collect_numbers
from posefilter.report.gather import Run

ROWS = (
    "instances", "missed", "add/auc", "add/recall_01d", "add/recall_2cm", "add/median_mm",
    "add_s/auc", "add_s/recall_01d", "add_s/recall_2cm", "add_s/median_mm",
    "add_up_to_symmetry/auc", "add_up_to_symmetry/recall_01d", "add_up_to_symmetry/median_mm",
    "mssd/ar", "mspd/ar", "iou", "particles_on_object", "seconds_per_image",
)  # fmt: skip


BELIEF = tuple(key for key in METRICS if key.startswith(("belief/", "credibility/")))


BY_VISIBILITY = ("add/auc", "add/recall_01d", "add/median_mm", "add_s/auc")


APART = ((0.0, 0.3), (0.3, 0.5), (0.5, 0.8), (0.8, 1.0))  # ranges of visibility that share no image


def list_results(run: Run) -> list[Block]:
    """Return the final table, and the errors by visibility."""
    if not run.metrics:
        return []
    columns = {"test": run.metrics}
    if run.metrics_train:
        columns = {"evaluation": run.metrics, "test after training": run.metrics_train}
    return [compare_numbers(columns), *list_visibility(run.metrics)]


def compare_numbers(columns: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return the main numbers, a column a metrics.json; what none of them has is left out."""
    rows: list[list[Cell]] = []
    for info in map(find_metric, ROWS):
        values = [read_number(metrics, info.key) for metrics in columns.values()]
        if any(value is not None for value in values):
            cells = ("–" if value is None else info.describe(value) for value in values)
            rows.append([info.label, *cells])
    return Table(("", *columns), rows, numeric=range(1, len(columns) + 1), form="narrow")


def list_visibility(metrics: Mapping[str, Any]) -> list[Block]:
    """Return errors by visibility: ranges that share no image, and apart from them those from a
    share upwards.
    """
    known = (metrics.get("by_visibility") or {}).items()
    found = {tuple(float(end) for end in name.split("-")): own for name, own in known}
    apart = {f"{ends[0]:g} to {ends[1]:g}": found[ends] for ends in APART if ends in found}
    above = {f"at least {ends[0]:g}": found[ends] for ends in sorted(found) if ends not in APART}
    out: list[Block] = []
    tables = {"By visibility": apart, "Where enough is visible": above}
    for heading, ranges in tables.items():
        rows = [
            [name, str(own["instances"]), *(format_number(own, key) for key in BY_VISIBILITY)]
            for name, own in ranges.items()
        ]
        head = ("visible share", "instances", *(find_metric(key).title for key in BY_VISIBILITY))
        out += [Heading(heading), Table(head, rows, numeric=range(1, len(head)))] if rows else []
    return out


def format_number(metrics: Mapping[str, Any], key: str) -> str:
    """Return a number of a metrics.json as a cell, a dash where there is none."""
    value = read_number(metrics, key)
    return "–" if value is None else find_metric(key).format(value)


def list_belief(run: Run) -> list[Block]:
    """Return what the belief's numbers are, and mean."""
    known = collect_numbers(run)
    infos = [find_metric(key) for key in BELIEF if key in known]
    rows: list[list[Cell]] = [
        [info.label, info.describe(known[info.key]), Text(info.meaning, "soft")] for info in infos
    ]
    return [Table(("mean over the images", "", ""), rows, numeric=(1,), form="meanings")]
