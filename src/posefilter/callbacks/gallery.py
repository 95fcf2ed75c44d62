"""What is kept of the images of a validation or test, and figures of them: the first, the best and
the worst.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from lightning import Trainer
from torch import Tensor

from posefilter.figures.canvas import ESTIMATE, TRUTH, arrange_grid, full_view, to_image
from posefilter.figures.layout import (
    DETAIL,
    add_caption,
    compose_figure,
    cut_text,
    draw_legend,
    format_length,
    tile_width,
)
from posefilter.figures.overlay import Shape, draw_poses, list_axes, view_poses
from posefilter.figures.particles import draw_particles, draw_weight_scale
from posefilter.meshes.store import MeshStore
from posefilter.metrics.beliefs import on_object
from posefilter.metrics.errors import add_up_to_symmetry
from posefilter.models.base import PoseEstimator
from posefilter.types import Batch, BeliefBatch, ParticleOutput, Particles, Trace

_COLUMNS = 3
_TILE = tile_width(_COLUMNS)


class KeptImage(NamedTuple):
    """What is kept of an image that may be drawn."""

    frame_id: int
    name: str  # of the frame
    # ADD up to symmetry [m]; for methods that tell no pose, the share of particles that miss
    error: float
    has_symmetries: bool  # the object: ADD up to symmetry is then another number than ADD
    rgb: np.ndarray  # (H, W, 3) uint8
    intrinsics: np.ndarray  # (3, 3) [px]
    estimate: np.ndarray  # (4, 4)
    truth: np.ndarray  # (4, 4)
    pixels: np.ndarray  # (N, 2) the last particles on the image [px]
    weights: np.ndarray  # (N,)


def compute_errors(trace: Trace, batch: Batch, method: PoseEstimator, points: Tensor) -> Tensor:
    """Return how wrong each image is, infinite where no number says: ADD up to symmetry [m], or the
    share of particles that miss.  (B,).
    """
    if "pose" in method.capabilities:
        best, truth = trace.belief.best.detach(), batch.camera_from_object
        error = add_up_to_symmetry(best, truth, points, method.object_model.symmetries.to(best))
    else:
        error = 1 - on_object(batch.mask, method.particle_pixels(trace.particles[-1], batch))
    return torch.nan_to_num(error.double(), nan=torch.inf)


class ImageSelection:
    """Keeps the first, the best and the worst images of a stage; an image is only copied where it
    is one of them.
    """

    def __init__(self, first: int, best: int, worst: int) -> None:
        self.counts = {"first": first, "best": best, "worst": worst}
        self.kept: dict[str, list[KeptImage]] = {name: [] for name in self.counts}

    def offer(self, error: float, make: Callable[[], KeptImage]) -> None:
        """Keep an image where it is among the first, the best or the worst so far."""
        kept, counts = self.kept, self.counts
        made: KeptImage | None = None
        if len(kept["first"]) < counts["first"]:
            made = make()
            kept["first"].append(made)
        for name, sign in (("best", 1), ("worst", -1)):
            ranked = kept[name]
            if counts[name] and (
                len(ranked) < counts[name] or sign * error < sign * ranked[-1].error
            ):
                made = made or make()
                ranked.append(made)
                ranked.sort(key=lambda one: sign * one.error)
                del ranked[counts[name] :]

    def separate(self) -> dict[str, list[KeptImage]]:
        """Return what is kept, no image both among the best and among the worst: of fewer images
        than both take, each takes its share.
        """
        best, worst = self.kept["best"], self.kept["worst"]
        every = [*best, *(one for one in worst[::-1] if all(one is not other for other in best))]
        if len(every) == len(best) + len(worst):
            return self.kept
        count = len(every) * self.counts["best"] // (self.counts["best"] + self.counts["worst"])
        return {**self.kept, "best": every[:count], "worst": every[count:][::-1]}


def name_frame(trainer: Trainer, split: str, frame_id: int) -> str:
    """Return a frame's name in its dataset, or its number where no dataset is at hand."""
    data = getattr(trainer, "datamodule", None)
    return str(data.records(split)[frame_id].name) if data is not None else f"image {frame_id}"


def keep_image(
    trace: Trace, batch: Batch, method: PoseEstimator, i: int, error: float, name: str
) -> KeptImage:
    """Copy what a drawing needs of one image."""
    numpy = lambda x: x[i].detach().cpu().double().numpy()  # noqa: E731
    particles = trace.particles[-1]
    pixels = method.particle_pixels(particles, batch)
    return KeptImage(
        int(batch.frame_id[i]),
        name,
        error,
        len(method.object_model.symmetries) > 1,
        to_image(batch.rgb[i]),
        numpy(batch.intrinsics),
        numpy(trace.belief.best),
        numpy(batch.camera_from_object),
        numpy(pixels),
        numpy(torch.softmax(particles.log_weights.double(), 1)),
    )


def select_image(trace: Trace, i: int) -> Trace:
    """Return the trace of one image alone, on the CPU, without gradients."""
    take = lambda x: x[i : i + 1].detach().cpu() if x.ndim else x.detach().cpu()  # noqa: E731
    return Trace(
        tuple(Particles(*map(take, particles)) for particles in trace.particles),
        # fragments: not for the eye
        tuple(ParticleOutput(*map(take, output[:-1])) for output in trace.outputs),
        tuple(step._replace(sigma=take(step.sigma)) for step in trace.steps),
        BeliefBatch(*map(take, trace.belief)),
    )


def find_shape(trainer: Trainer, method: PoseEstimator) -> Shape:
    """Return what outlines are drawn from: the mesh where the data has it, else the hull that the
    method carries.
    """
    store = getattr(getattr(trainer, "datamodule", None), "meshes", None)
    if isinstance(store, MeshStore) and store.has(method.object_model.name):
        return store.load(method.object_model.name)
    return method.object_model.hull


def draw_gallery(
    kept: Sequence[KeptImage], shape: Shape, tells_pose: bool, title: str
) -> np.ndarray:
    """Draw images side by side, in rows, under a title and above what the lines mean."""
    tiles = arrange_grid([draw_tile(one, shape, tells_pose) for one in kept], _COLUMNS)
    if not tells_pose:
        return compose_figure(title, tiles, draw_weight_scale())
    legend = draw_legend([("truth", TRUTH), ("estimate", ESTIMATE), *list_axes()])
    return compose_figure(title, tiles, legend)


def draw_tile(one: KeptImage, shape: Shape, tells_pose: bool) -> np.ndarray:
    """Draw one image: a close-up of estimate and truth, or the particles where no pose is told."""
    height, width = one.rgb.shape[:2]
    if tells_pose:
        view = view_poses([one.estimate, one.truth], shape, one.intrinsics, height, width, _TILE)
        picture = draw_poses(
            one.rgb, one.intrinsics, one.estimate, shape, view, truth=one.truth, coarse=2
        )
        name = "ADD up to symmetry" if one.has_symmetries else "ADD"
        caption = f"{name} {format_length(one.error)}"
    else:
        picture = draw_particles(one.rgb, one.pixels, one.weights, full_view(height, width, _TILE))
        caption = f"{1 - one.error:.0%} on object"
    return add_caption(picture, caption, note=cut_text(one.name, DETAIL, picture.shape[1]))
