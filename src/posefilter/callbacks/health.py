"""The filter's health by iteration: effective sample size, spread, noise level, log-likelihood."""

from pathlib import Path

import torch
from lightning import LightningModule, Trainer

from posefilter.callbacks.tensorboard import BudgetedCallback, log_numbers, post_image
from posefilter.figures.curves import draw_health
from posefilter.figures.particles import choose_steps
from posefilter.geometry.spaces import PoseSpace
from posefilter.metrics.beliefs import spread
from posefilter.models.base import PoseEstimator
from posefilter.protocols import Space
from posefilter.types import Batch, Trace


class FilterHealth(BudgetedCallback):
    """Average over the validation images, and log `filter/<quantity>/step_<iteration>` and one
    figure.

    Args:
        folder: Where the figure is written too; None: nowhere.
        max_iterations: Largest number of iterations that are logged as scalars, evenly chosen.
        max_time_fraction: Largest fraction of the validations' time that the figure takes; None: no
            limit. Drawing that would take more is put off to a later validation.
    """

    def __init__(
        self,
        folder: str | Path | None = None,
        max_iterations: int = 20,
        max_time_fraction: float | None = 0.005,
    ) -> None:
        super().__init__(folder, max_time_fraction)
        self.max_iterations = max_iterations
        self._sums: dict[str, torch.Tensor] = {}
        self._images = 0

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Forget the last validation."""
        self._sums, self._images = {}, 0
        super().on_validation_epoch_start(trainer, pl_module)

    def on_validation_trace(
        self, trainer: Trainer, method: PoseEstimator, trace: Trace, batch: Batch
    ) -> None:
        """Take in one batch."""
        for name, values in measure_health(trace, method.space).items():
            total = values.sum(0).cpu()
            self._sums[name] = self._sums[name] + total if name in self._sums else total
        self._images += len(trace.belief.best)

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the means."""
        self.budget.stop()
        curves = self.curves()
        if not curves or not trainer.is_global_zero:
            return
        log_numbers(trainer, name_scalars(curves, self.max_iterations))
        images, step = self._images, trainer.global_step

        def draw() -> None:
            picture = draw_health(curves, images, f"Filter health\nstep {step}")
            post_image(trainer, "health", picture, self.folder, step=step)

        self.budget.draw(draw)

    def curves(self) -> dict[str, list[float]]:
        """Return the means over the images by name, one number an iteration."""
        return {name: (total / self._images).tolist() for name, total in self._sums.items()}


def measure_health(trace: Trace, space: Space) -> dict[str, torch.Tensor]:
    """Measure a run of the filter.

    Args:
        trace: Of B images over T steps.
        space: The space of the particles.

    Returns:
        By name, (B, T) each: `ess`, 1 / sum w^2 over the number of particles, in (0, 1];
        `spread_*`, weighted root mean square distance from the mean; `sigma_*`, noise level;
        `best_log_likelihood`, of the image's best particle.
    """
    steps: list[dict[str, torch.Tensor]] = []
    for particles, output, step in zip(trace.particles, trace.outputs, trace.steps, strict=True):
        state, log_weights = particles.state.detach(), particles.log_weights.detach().float()
        weights = log_weights.exp()
        row = {"ess": 1 / weights.square().sum(1) / weights.shape[1]}
        if isinstance(space, PoseSpace):
            row["spread_m"], row["spread_rad"] = spread(output.pose.detach(), log_weights, space)
        else:
            mean = space.mean(state, weights)[:, None]
            row["spread_px"] = (weights * space.distance(state, mean).square()).sum(1).sqrt()
        unit = "m" if isinstance(space, PoseSpace) else "px"
        row[f"sigma_{unit}"] = step.sigma.detach().to(weights).expand(len(weights))
        row["best_log_likelihood"] = output.log_likelihood.detach().float().max(1).values
        steps.append(row)
    return {name: torch.stack([row[name] for row in steps], dim=1).double() for name in steps[0]}


def name_scalars(curves: dict[str, list[float]], max_steps: int) -> dict[str, float]:
    """Return curves as scalars with names that sort, `filter/ess/step_03`: `max_steps` of each,
    evenly chosen.
    """
    out: dict[str, float] = {}
    for name, values in curves.items():
        # a single one is the last
        for step in choose_steps(len(values), max_steps) if max_steps > 1 else [len(values) - 1]:
            out[f"filter/{name}/step_{step:02d}"] = values[step]
    return out
