"""Show the image-space methods' signs of failure: curves over the iterations, the particles' journeys, and a short film."""

from pathlib import Path
from typing import Any, cast

import torch
from lightning import Callback, LightningModule, Trainer

from posefilter.callbacks.board import Budget, post
from posefilter.callbacks.drawings import Filmed, filmed
from posefilter.callbacks.gallery import one_image
from posefilter.callbacks.journeys import lineage
from posefilter.metrics.signs import SignsOfFailure
from posefilter.models.base import PoseEstimator
from posefilter.pictures.canvas import AXES, Colour, to_picture
from posefilter.pictures.curves import draw_shares
from posefilter.pictures.journeys import draw_journeys
from posefilter.types import Batch, Trace

LISTS: dict[str, Colour] = {
    "on_object": AXES[1],
    "off_frame": AXES[0],
    "near_edge": AXES[2],
    "near_corner": (240, 160, 30),
}
NUMBERS = ("pairwise_cosine", "offset_r2", "heading", "auroc")


class Signs(Callback):
    """Log where the particles are, step by step, after each validation; draw it of a test, and its first images' journeys.

    The numbers themselves are among the method's metrics (val/signs/...); a validation's journeys are among its figures.
    folder: where figures and films are written (null: nowhere); images: how many are drawn; share: of the validations' time
    that the curves may take (null: no limit). Silent for methods whose particles are no pixels.
    """

    def __init__(self, folder: str | Path | None = None, images: int = 2, share: float | None = 0.005) -> None:
        self.folder = None if folder is None else Path(folder)
        self.images = images
        self.budget = Budget(share)

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock."""
        self.budget.start()

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the shares of particles, step by step."""
        self.budget.stop()
        scores = cast(torch.nn.ModuleDict, pl_module.scores)
        if "signs" not in scores or trainer.sanity_checking or not trainer.is_global_zero:
            return
        found = cast(SignsOfFailure, scores["signs"]).compute()
        for logger in trainer.loggers:
            logger.log_metrics({f"signs/{name}/last": found[name][-1] for name in LISTS}, trainer.global_step)
        if self.budget.allows():
            with self.budget.spend():
                title = f"Signs of failure\nafter {trainer.global_step} steps of training"
                self._post(trainer, "figures/signs", "validation_signs", draw_signs(found, title))

    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, dataloader_idx: int = 0
    ) -> None:
        """Draw and film the first batch's journeys."""
        if batch_idx == 0 and on_pixels(outputs):
            self.draw(trainer, cast(PoseEstimator, pl_module), outputs, batch)

    def on_test_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw where the particles of the test were: of validations, the last one drawn may be an early one."""
        scores = cast(torch.nn.ModuleDict, pl_module.scores)
        if "signs" in scores and trainer.is_global_zero:
            found = cast(SignsOfFailure, scores["signs"]).compute()
            self._post(trainer, "figures/signs_test", "test_signs", draw_signs(found, "Signs of failure\nof the test"))

    def draw(self, trainer: Trainer, method: PoseEstimator, trace: Trace, batch: Batch) -> None:
        """Draw and film the journeys of a batch's first images."""
        states = lineage(trace.clouds)
        for i in range(min(self.images, len(states))):
            rgb, mask, number = to_picture(batch.rgb[i]), batch.mask[i, 0].cpu().numpy(), int(batch.frame_id[i])
            picture = draw_journeys(rgb, mask, states[i].cpu().numpy(), f"Journeys\nimage {number} of the test")
            self._post(trainer, f"journeys/test_{i}", f"test_journeys_{i}", picture)
            K, truth = (x[i].cpu().double().numpy() for x in (batch.intrinsics, batch.camera_from_object))
            scene = Filmed(rgb, K, truth, mask)
            film = filmed(method, one_image(trace, i), scene, f"The filter at work\nimage {number} of the test")
            self._post(trainer, f"journeys/film_{i}", f"test_film_{i}", film)

    def _post(self, trainer: Trainer, tag: str, file: str, picture: Any) -> None:
        post(trainer, tag, picture, self.folder and self.folder / file)


def on_pixels(outputs: Any) -> bool:
    """Tell whether a step's outputs are a trace of particles that are pixels."""
    return isinstance(outputs, Trace) and outputs.clouds[-1].state.shape[2:] == (2,)


def draw_signs(found: dict[str, Any], title: str) -> Any:
    """Draw the shares of particles on the object, off the frame, at an edge and in a corner against the step."""
    foot = ", ".join(f"{name.replace('_', ' ')} {found[name]:.2f}" for name in NUMBERS)
    return draw_shares({name: (found[name], colour) for name, colour in LISTS.items()}, title, foot)
