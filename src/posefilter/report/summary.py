"""Draw what a sweep found on one figure: each metric over each swept setting."""

from dataclasses import replace

from matplotlib.figure import Figure

from posefilter.figures.canvas import create_figure
from posefilter.metrics.registry import find_metric
from posefilter.report.charts import LIGHT, WIDTH_PX, draw_panel, measure_height
from posefilter.report.sweep_charts import chart_over
from posefilter.report.sweeps import Sweep, group_jobs

SHOWN = ("add/auc", "iou", "particles_on_object", "seconds_per_image")
_TITLE_PX = 60


def draw_summary(sweep: Sweep) -> Figure | None:
    """Draw quality and cost over each swept setting, as the charts of the sweep's page.

    Where each setting was run once nothing is joined, and the title says so: one seed is no trend.

    Returns:
        The figure; None where no setting has been run with two values yet.
    """
    found = group_jobs(sweep)
    once = len(found) == len(sweep.jobs)
    infos = [find_metric(key) for key in SHOWN]
    charts = {axis: chart_over(axis, sweep, found, infos) for axis in sweep.shown}
    charts = {axis: row for axis, row in charts.items() if row}
    rows = [[replace(panel, joined=not once) for panel in row] for row in charts.values()]
    if not rows:
        return None
    heights, columns = [measure_height(row[0]) for row in rows], len(rows[0])
    figure = create_figure(columns * WIDTH_PX, sum(heights) + _TITLE_PX)
    figure.set_layout_engine("constrained")
    count = f"{len(sweep.jobs)} run{'s' * (len(sweep.jobs) != 1)}"
    several = "line or large dot: mean over seeds; small dots: runs"
    notes = "one seed each: differences may be chance" if once else several
    title = f"Sweep over {', '.join(sweep.shown)}: {count}\n{notes}"
    figure.suptitle(title, fontsize=12, fontweight="bold")
    axes = figure.subplots(len(rows), columns, squeeze=False, height_ratios=heights)
    for line, row in zip(axes, rows, strict=True):
        for own, panel in zip(line, row, strict=True):
            draw_panel(own, panel, LIGHT)
        if row[0].categories:
            line[0].set_ylabel(row[0].xlabel, fontsize=8.5)
        if len(row[0].lines) > 1:
            line[0].legend(fontsize=8, frameon=False)
    return figure
