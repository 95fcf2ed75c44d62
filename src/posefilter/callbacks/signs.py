"""Show the image-space methods' signs of failure: curves over the iterations, the particles' journeys, and a short film."""

from pathlib import Path
from typing import Any, cast

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from posefilter.callbacks.journeys import journey_figure, journey_film, lineage, save_film
from posefilter.metrics.signs import SignsOfFailure
from posefilter.types import Batch, Trace

LISTS = ("on_object", "off_frame", "near_edge", "near_corner")


class Signs(Callback):
    """Draw the journeys of the first images of each validation and test, and log where the particles are, step by step.

    The numbers themselves are among the method's metrics (val/signs/...). folder: where figures and the film are written
    (null: nowhere); images: how many are drawn. Silent for methods whose particles are no pixels.
    """

    def __init__(self, folder: str | Path | None = None, images: int = 2) -> None:
        self.folder = None if folder is None else Path(folder)
        self.images = images

    def on_validation_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, dataloader_idx: int = 0
    ) -> None:
        """Draw the first batch's journeys."""
        if batch_idx == 0 and not trainer.sanity_checking and on_pixels(outputs):
            self.draw(trainer, outputs, batch, "validation", film=False)

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, dataloader_idx: int = 0
    ) -> None:
        """Draw and film the first batch's journeys."""
        if batch_idx == 0 and on_pixels(outputs):
            self.draw(trainer, outputs, batch, "test", film=True)

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the shares of particles, step by step."""
        scores = cast(torch.nn.ModuleDict, pl_module.scores)
        if "signs" not in scores or trainer.sanity_checking:
            return
        found = cast(SignsOfFailure, scores["signs"]).compute()
        self.show(trainer, curves_figure(found), "signs/by_step", "validation_signs")
        for logger in trainer.loggers:
            logger.log_metrics({f"signs/{name}/last": found[name][-1] for name in LISTS}, trainer.global_step)

    def draw(self, trainer: Trainer, trace: Trace, batch: Batch, stage: str, film: bool) -> None:
        """Draw the journeys of a batch's first images."""
        states = lineage(trace.clouds)
        for i in range(min(self.images, len(states))):
            figure = journey_figure(batch.rgb[i], batch.mask[i], states[i])
            self.show(trainer, figure, f"journeys/{stage}_{i}", f"{stage}_journeys_{i}")
            if film and self.folder is not None:
                between = max(1, 24 // states.shape[1])
                save_film(
                    journey_film(batch.rgb[i], batch.mask[i], states[i], between), self.folder / f"{stage}_journeys_{i}.webp"
                )

    def show(self, trainer: Trainer, figure: Figure, tag: str, file: str) -> None:
        """Hand a figure to TensorBoard, and write it down."""
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_figure(tag, figure, trainer.global_step)
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
            figure.savefig(self.folder / f"{file}.png", dpi=110)


def on_pixels(outputs: Any) -> bool:
    """Tell whether a step's outputs are a trace of particles that are pixels."""
    return isinstance(outputs, Trace) and outputs.clouds[-1].state.shape[2:] == (2,)


def curves_figure(found: dict[str, Any]) -> Figure:
    """Draw the shares of particles on the object, off the frame, at an edge and in a corner against the step."""
    figure = Figure(figsize=(6, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for name in LISTS:
        axes.plot(range(len(found[name])), [100 * x for x in found[name]], marker=".", label=name.replace("_", " "))
    axes.set(xlabel="step", ylabel="share of the particles [%]", ylim=(-3, 103))
    numbers = ("pairwise_cosine", "offset_r2", "heading", "auroc")
    axes.set_title(", ".join(f"{name.replace('_', ' ')} {found[name]:.2f}" for name in numbers), fontsize=9)
    axes.legend()
    return figure
