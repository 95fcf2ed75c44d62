"""Charts and tables of the errors of single images: how many are below a threshold, and how they
grow with occlusion.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from posefilter.errors import UserError
from posefilter.figures.layout import format_length
from posefilter.metrics.image_errors import FILE, ImageError, read_errors, summarize_images
from posefilter.metrics.registry import PERCENT, find_metric
from posefilter.report.blocks import Block, Cell, Fold, Heading, Paragraph, Table, Text, draw_charts
from posefilter.report.charts import Line, Panel

LIMIT_MM = 100.0  # of thresholds: the AUC's own
FEWEST = 8  # images in a range of visibility
MOST = 8  # ranges of visibility
LISTED = 12  # images in a table of the worst
EQUAL_MM = 0.05  # errors that differ by less are written alike


def read_image_errors(folder: Path) -> list[ImageError]:
    """Return the rows of a run's errors.csv, none where it has no such file.

    Raises:
        UserError: Where the file is malformed.
    """
    path = folder / FILE
    if not path.is_file():
        return []
    try:
        return read_errors(path)
    except ValueError as error:
        raise UserError(f"{path}: is no table of errors ({error})") from error


def compute_cdf(errors_mm: Sequence[float]) -> tuple[list[float], list[float]]:
    """Return the share of the images whose error is at most a threshold.

    Args:
        errors_mm: An error an image; infinite where it was missed.

    Returns:
        Thresholds [mm], from 0 to the limit, and the shares there [%]; a step is two points.
    """
    within = sorted(error for error in errors_mm if error < LIMIT_MM)
    x, y = [0.0], [0.0]
    for number, error in enumerate(within, start=1):
        x += [error, error]
        y += [y[-1], 100 * number / len(errors_mm)]
    return [*x, LIMIT_MM], [*y, y[-1]]


def group_by_visibility(rows: Sequence[ImageError]) -> list[list[ImageError]]:
    """Return the images in ranges of their visible share, about as many in each, but that images of
    one share are in one range; unknown shares are left out.
    """
    known = [row for row in rows if math.isfinite(row.visibility)]
    known.sort(key=lambda row: row.visibility)
    count = min(MOST, len(known) // FEWEST)
    if count < 2:
        return []
    parts = list[list[ImageError]]()
    for numbers in np.array_split(np.arange(len(known)), count):
        part = [known[i] for i in numbers]
        # often half of the images show the whole object: cut apart, they would differ by chance
        if parts and parts[-1][-1].visibility == part[0].visibility:
            parts[-1] += part
        else:
            parts.append(part)
    return parts if len(parts) > 1 else []


def chart_errors(runs: Mapping[str, Sequence[ImageError]]) -> list[Panel]:
    """Return the charts of one run's errors, or of several, a line each; the name of a single one
    is not shown.
    """
    posed = {n for n, rows in runs.items() if any(math.isfinite(r.diameter_mm) for r in rows)}
    runs = {
        name: [row for row in rows if not math.isnan(row.add_mm)]
        for name, rows in runs.items()
        if name in posed
    }
    alone = len(runs) == 1
    symmetric = has_symmetries([row for rows in runs.values() for row in rows])
    error = "add_up_to_symmetry" if symmetric else "add"
    kinds = {"ADD up to symmetry": "add_up_to_symmetry_mm"} if symmetric else {}
    kinds |= {"ADD": "add_mm", "ADD-S": "add_s_mm"}
    kind = next(iter(kinds))
    cdf = list[Line]()
    by_visibility: dict[str, list[Line]] = {"auc": [], "recall_01d": []}
    for name, rows in runs.items():
        for label, column in kinds.items() if alone else [(name, kinds[kind])]:
            cdf.append(Line(label, *compute_cdf([getattr(row, column) for row in rows])))
        parts = group_by_visibility(rows)
        seen = [float(np.mean([row.visibility for row in part])) for part in parts]
        found = [summarize_images(part, symmetric)[error] for part in parts]
        for key, lines in by_visibility.items():
            lines += [Line(name, seen, [one[key] for one in found])] if parts else []
    threshold = f"threshold of the {kind} [mm]" if symmetric and not alone else "threshold [mm]"
    out = [Panel("Images with an error below a threshold", threshold, "%", cdf, PERCENT)]
    for key, lines in by_visibility.items():
        info = find_metric(f"{error}/{key}")
        out.append(Panel(f"{info.label} by visibility", "visible share", info.unit, lines, PERCENT))
    return [panel for panel in out if panel.lines]


def has_symmetries(rows: Sequence[ImageError]) -> bool:
    """Tell whether objects have symmetries that count: all errors up to symmetry are known, and
    some are less than the ADD.
    """
    known = not any(math.isnan(row.add_up_to_symmetry_mm) for row in rows)
    return known and any(row.add_up_to_symmetry_mm < row.add_mm - EQUAL_MM for row in rows)


def show_errors(rows: Sequence[ImageError]) -> list[Block]:
    """Return the charts of one run's errors, and its worst images by name; nothing where there are
    none.
    """
    if not rows:
        return []
    return [*draw_charts(chart_errors({"": rows})), *list_worst(rows)]


def list_worst(rows: Sequence[ImageError]) -> list[Block]:
    """Return the images with the greatest errors, by name."""
    posed = [row for row in rows if not math.isnan(row.add_mm)]
    worst = sorted(posed, key=lambda row: -row.error_mm)[:LISTED]
    symmetric = has_symmetries(posed)
    worst = worst or sorted(rows, key=lambda row: row.particles_on_object)[:LISTED]
    cells: list[list[Cell]] = [
        [
            Text(row.image, "code"),
            "–" if math.isnan(row.visibility) else f"{row.visibility:.2f}",
            "–" if math.isnan(row.add_mm) else format_length(row.add_mm / 1000),
            *([format_length(row.error_mm / 1000)] if symmetric else []),
            "–" if math.isnan(row.add_s_mm) else format_length(row.add_s_mm / 1000),
            f"{row.particles_on_object:.0%}" if math.isfinite(row.particles_on_object) else "–",
        ]
        for row in worst
    ]
    kinds = ("ADD", "ADD up to symmetry", "ADD-S") if symmetric else ("ADD", "ADD-S")
    head = ("image", "visible share", *kinds, "particles on the object")
    where = Paragraph(["Every image is in", Text(FILE, "code"), "in the run's folder."])
    table = Table(head, cells, numeric=range(1, len(head)))
    fold = Fold(f"The {len(worst)} worst of {len(rows)} images", [table])
    return [Heading("Images"), fold, where]
