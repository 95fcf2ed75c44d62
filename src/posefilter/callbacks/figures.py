"""Pictures of each validation: the best, the worst and the first images, the particles' way, and the belief."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor

from posefilter.callbacks.board import Budget, post
from posefilter.data.meshes import MeshStore
from posefilter.geometry.deviation import thin
from posefilter.metrics.beliefs import on_object
from posefilter.metrics.errors import add
from posefilter.models.base import PoseEstimator
from posefilter.pictures.belief import draw_belief
from posefilter.pictures.canvas import ESTIMATE, TRUTH, grid, rasterise, strip, to_picture, whole
from posefilter.pictures.cloud import draw_cloud, draw_strip
from posefilter.pictures.overlay import Shape, axes_legend, overlay, view_of_poses
from posefilter.types import Batch, Belief, Cloud, Reading, Trace

_TILE = 480  # [px]


class Shown(NamedTuple):
    """What is kept of an image that may be drawn."""

    frame_id: int
    error: float  # ADD [m]; for methods that tell no pose, the share of the particles that miss the object
    rgb: np.ndarray  # (H, W, 3) uint8
    intrinsics: np.ndarray  # (3, 3) [px]
    estimate: np.ndarray  # (4, 4)
    truth: np.ndarray  # (4, 4)
    pixels: np.ndarray  # (N, 2) the last cloud on the image [px]
    weights: np.ndarray  # (N,)


class Figures(Callback):
    """Draw overlays, particles and the belief after each `every`-th validation, into TensorBoard and `folder`.

    folder: null for TensorBoard alone; first, best, worst: how many images of each kind; share: of the validations' time
    that drawing may take on the whole (null: no limit): drawing that would take more is put off to a later validation, at
    the latest to the end of the training. Only looks: neither the method nor any random generator is touched.
    """

    def __init__(
        self,
        folder: str | Path | None = None,
        every: int = 1,
        first: int = 4,
        best: int = 2,
        worst: int = 2,
        share: float | None = 0.05,
    ) -> None:
        self.folder = None if folder is None else Path(folder)
        self.every, self.counts = every, {"first": first, "best": best, "worst": worst}
        self.budget = Budget(share)
        self._validations = 0
        self._kept: dict[str, list[Shown]] = {}
        self._example: tuple[Shown, Trace] | None = None
        self._put_off = False
        self._points: Tensor | None = None

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Forget the last validation."""
        self._kept, self._example, self._points = {name: [] for name in self.counts}, None, None
        self.budget.start()

    def on_validation_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int, dataloader_idx: int = 0
    ) -> None:
        """Keep the images that may be drawn."""
        if trainer.sanity_checking or not isinstance(outputs, Trace) or self._validations % self.every:
            return
        method = _method(pl_module)
        if self._points is None:
            self._points = thin(method.model.points, 256).to(batch.rgb.device)
        errors = errors_of(outputs, batch, method, self._points).tolist()
        for i, error in enumerate(errors):
            self._offer(error, partial(shown, outputs, batch, method, i, error))
        if self._example is None:
            self._example = (self._kept["first"] or [shown(outputs, batch, method, 0, errors[0])])[0], one_image(outputs, 0)

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw, or put it off."""
        if trainer.sanity_checking:
            return
        self.budget.stop()
        self._validations += 1
        if self._example is None:
            return
        self._put_off = not self.budget.allows()
        if not self._put_off:
            self.draw(trainer, _method(pl_module))

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw the last validation, if that was put off."""
        if self._put_off:
            self.draw(trainer, _method(pl_module))
            self._put_off = False

    def draw(self, trainer: Trainer, method: PoseEstimator) -> None:
        """Draw what was kept."""
        if self._example is None or not trainer.is_global_zero:
            return
        with self.budget.spend():
            shape = shape_of(trainer, method)
            when = f"after {trainer.global_step} steps of training"
            self._post(trainer, "overlays", draw_gallery(self._kept, shape, method.tells_pose, f"Estimates {when}"))
            example, trace = self._example
            title = f"Particles over the filter's iterations, image {example.frame_id}, {when}"
            self._post(trainer, "particles", draw_strip(example.rgb, example.intrinsics, trace, 0, method.space, title))
            if method.tells_pose:
                title = f"Belief about image {example.frame_id} {when}"
                args = (trace.belief, method.model, example.rgb, example.intrinsics, example.truth, title)
                self._post(trainer, "belief", rasterise(draw_belief(*args)))

    def _post(self, trainer: Trainer, name: str, picture: np.ndarray) -> None:
        post(trainer, f"figures/{name}", picture, None if self.folder is None else self.folder / f"validation_{name}.png")

    def _offer(self, error: float, make: Callable[[], Shown]) -> None:
        """Keep an image where it is among the first, the best or the worst so far; it is only copied if so."""
        kept, counts = self._kept, self.counts
        made: Shown | None = None
        if len(kept["first"]) < counts["first"]:
            made = make()
            kept["first"].append(made)
        for name, sign in (("best", 1), ("worst", -1)):
            ranked = kept[name]
            if counts[name] and (len(ranked) < counts[name] or sign * error < sign * ranked[-1].error):
                made = made or make()
                ranked.append(made)
                ranked.sort(key=lambda one: sign * one.error)
                del ranked[counts[name] :]


def errors_of(trace: Trace, batch: Batch, method: PoseEstimator, points: Tensor) -> Tensor:
    """Return how wrong each image is, infinite where no number says: ADD [m], or the share of particles that miss.  (B,)."""
    if method.tells_pose:
        error = add(trace.belief.best.detach(), batch.camera_from_object, points)
    else:
        error = 1 - on_object(batch.mask, method.particle_pixels(trace.clouds[-1], batch))
    return torch.nan_to_num(error.double(), nan=torch.inf)


def shown(trace: Trace, batch: Batch, method: PoseEstimator, i: int, error: float) -> Shown:
    """Copy what a drawing needs of one image."""
    numpy = lambda x: x[i].detach().cpu().double().numpy()  # noqa: E731
    cloud = trace.clouds[-1]
    pixels = method.particle_pixels(cloud, batch)
    return Shown(
        int(batch.frame_id[i]),
        error,
        to_picture(batch.rgb[i]),
        numpy(batch.intrinsics),
        numpy(trace.belief.best),
        numpy(batch.camera_from_object),
        numpy(pixels),
        numpy(torch.softmax(cloud.log_weights.double(), 1)),
    )


def one_image(trace: Trace, i: int) -> Trace:
    """Return the trace of one image alone, on the CPU, without gradients."""
    take = lambda x: x[i : i + 1].detach().cpu() if x.ndim else x.detach().cpu()  # noqa: E731
    return Trace(
        tuple(Cloud(*map(take, cloud)) for cloud in trace.clouds),
        tuple(Reading(*map(take, reading)) for reading in trace.readings),
        tuple(step._replace(sigma=take(step.sigma)) for step in trace.steps),
        Belief(*map(take, trace.belief)),
    )


def shape_of(trainer: Trainer, method: PoseEstimator) -> Shape:
    """Return what outlines are drawn from: the mesh where the data has it, else the hull that the method carries."""
    store = getattr(getattr(trainer, "datamodule", None), "meshes", None)
    if isinstance(store, MeshStore) and method.model.name in store.names():
        return store.load(method.model.name)
    return method.model.hull


def draw_gallery(kept: dict[str, list[Shown]], shape: Shape, tells_pose: bool, title: str) -> np.ndarray:
    """Draw the first images in one row, the worst and the best in the next."""
    tiles = [draw_tile(one, shape, tells_pose, "") for one in kept["first"]]
    for name in ("worst", "best"):
        tiles += [draw_tile(one, shape, tells_pose, f"{name}: ") for one in kept[name]]
    sheet = grid(tiles, 4)
    legend = [("truth", TRUTH), ("estimate", ESTIMATE), *axes_legend()] if tells_pose else []
    return np.concatenate([strip(sheet.shape[1], title, legend, size=26), sheet])


def draw_tile(one: Shown, shape: Shape, tells_pose: bool, kind: str) -> np.ndarray:
    """Draw one image: a close-up of estimate and truth, or the particles where no pose is told."""
    height, width = one.rgb.shape[:2]
    if tells_pose:
        view = view_of_poses([one.estimate, one.truth], shape, one.intrinsics, height, width, _TILE)
        picture = overlay(one.rgb, one.intrinsics, one.estimate, shape, view, truth=one.truth)
        caption = f"{kind}image {one.frame_id}, ADD {1000 * one.error:.3g} mm"
    else:
        picture = draw_cloud(one.rgb, one.pixels, one.weights, whole(height, width, _TILE))
        caption = f"{kind}image {one.frame_id}, {1 - one.error:.0%} on the object"
    return np.concatenate([strip(_TILE, caption, size=22), picture])


def _method(module: LightningModule) -> PoseEstimator:
    assert isinstance(module, PoseEstimator)
    return module
