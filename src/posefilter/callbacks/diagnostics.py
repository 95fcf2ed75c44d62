"""Show how the image-space methods fail: curves over the iterations, the particles' trajectories, a
short animation.
"""

from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from lightning import LightningModule, Trainer

from posefilter.callbacks.drawings import animate
from posefilter.callbacks.gallery import name_frame, select_image
from posefilter.callbacks.tensorboard import BudgetedCallback, log_numbers, post_image
from posefilter.figures.canvas import AXES, Color, to_image
from posefilter.figures.curves import draw_shares
from posefilter.figures.trajectories import draw_trajectories, trace_lineage
from posefilter.metrics.diagnostics import FilterDiagnostics
from posefilter.metrics.registry import find_metric
from posefilter.models.base import PoseEstimator
from posefilter.types import Batch, Trace

LISTS: dict[str, Color] = {
    "on_object": AXES[1],
    "off_frame": AXES[0],
    "near_edge": AXES[2],
    "near_corner": (240, 160, 30),
    "first_axis_share": (150, 90, 200),
}
NUMBERS = ("pairwise_cosine", "offset_r2", "offset_cosine", "auroc")


class Diagnostics(BudgetedCallback):
    """Log where the particles are, step by step, after each validation; draw it of a test, with
    trajectories of some images.

    The numbers themselves are among the method's metrics (val/diagnostics/...).  Silent for methods
    whose particles are no pixels.

    Args:
        folder: Where figures and animations are written; nowhere if null.
        images: How many images are drawn.
        max_time_fraction: Part of the validations' time that the curves may take; no limit if null.
    """

    def __init__(
        self,
        folder: str | Path | None = None,
        images: int = 2,
        max_time_fraction: float | None = 0.005,
    ) -> None:
        super().__init__(folder, max_time_fraction)
        self.images = images

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the shares of particles, step by step."""
        self.budget.stop()
        scores = cast(torch.nn.ModuleDict, pl_module.scores)
        if "diagnostics" not in scores or trainer.sanity_checking or not trainer.is_global_zero:
            return
        found = cast(FilterDiagnostics, scores["diagnostics"]).compute()
        log_numbers(trainer, {f"diagnostics/{name}/last": found[name][-1] for name in LISTS})
        step = trainer.global_step

        def draw() -> None:
            picture = draw_diagnostics(found, f"Diagnostics\nstep {step}")
            post_image(trainer, "diagnostics", picture, self.folder, step=step)

        self.budget.draw(draw)

    def on_test_trace(
        self, trainer: Trainer, method: PoseEstimator, trace: Trace, batch: Batch, number: int
    ) -> None:
        """Draw and animate the first batch's trajectories."""
        if number == 0 and trainer.is_global_zero and has_pixel_particles(trace):
            self.draw(trainer, method, trace, batch)

    def on_test_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw where the particles of the test were: of validations, the last one drawn may be an
        early one.
        """
        scores = cast(torch.nn.ModuleDict, pl_module.scores)
        if "diagnostics" in scores and trainer.is_global_zero:
            found = cast(FilterDiagnostics, scores["diagnostics"]).compute()
            figure = draw_diagnostics(found, "Diagnostics\nof the test")
            step = cast(PoseEstimator, pl_module).trained.step
            post_image(trainer, "diagnostics", figure, self.folder, "test", step)

    def draw(self, trainer: Trainer, method: PoseEstimator, trace: Trace, batch: Batch) -> None:
        """Draw and animate the trajectories of a batch's first images."""
        states, step = trace_lineage(trace.particles), method.trained.step
        for i in range(min(self.images, len(states))):
            rgb, mask = to_image(batch.rgb[i]), batch.mask[i, 0].cpu().numpy()
            name = name_frame(trainer, "test", int(batch.frame_id[i]))
            title = f"Trajectories\n{name} of the test"
            picture = draw_trajectories(rgb, mask, states[i].cpu().numpy(), title)
            post_image(trainer, f"trajectories_{i}", picture, self.folder, "test", step)
            pair = (batch.intrinsics, batch.camera_from_object)
            K, truth = (x[i].cpu().double().numpy() for x in pair)
            title = f"The filter at work\n{name} of the test"
            animation = animate(method, select_image(trace, i), rgb, K, truth, mask, title)
            post_image(trainer, f"animation_{i}", animation, self.folder, "test", step)


def has_pixel_particles(trace: Trace) -> bool:
    """Return whether particles are pixels."""
    return trace.particles[-1].state.shape[2:] == (2,)


def draw_diagnostics(found: dict[str, Any], title: str) -> np.ndarray:
    """Draw where the particles are against the step.

    Args:
        found: What `FilterDiagnostics` computed.
        title: Of the figure.

    Returns:
        A figure (H, 600, 3) uint8: shares of particles on the object, off the frame, at an edge and
        in a corner, and of their variance along its first principal axis; below it the numbers that
        are one for all steps.
    """
    numbers = [(find_metric(f"diagnostics/{name}"), found[name]) for name in NUMBERS]
    foot = ", ".join(f"{info.short} {info.describe(value)}" for info, value in numbers)
    lines = {
        find_metric(f"diagnostics/{name}").label: (found[name], color)
        for name, color in LISTS.items()
        if np.isfinite(found[name]).all()  # particles that all coincide are on no line
    }
    return draw_shares(lines, title, foot)
