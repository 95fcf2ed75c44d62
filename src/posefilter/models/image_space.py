"""What the four image-space methods share: a particle is a pixel, and reads the image where it
stands.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import torch
import torch.nn.functional as F
from torch import Generator, Tensor, nn

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.filters.loop import ParticleFilter
from posefilter.geometry.camera import back_project
from posefilter.geometry.lookup import gather_pixels, nearest_pixel
from posefilter.geometry.spaces import PixelSpace
from posefilter.metrics.diagnostics import FilterDiagnostics
from posefilter.models.base import PoseEstimator
from posefilter.models.box_heads import BoxHead
from posefilter.models.loss_schedule import Auxiliary, Stage, check_loss_schedule, factors_at
from posefilter.nets.context import ContextMap
from posefilter.nets.glimpse import IntegerCut, SmoothGlimpse
from posefilter.nets.heads import fill_depth
from posefilter.types import Batch, ObjectModel, ParticleOutput, Particles, Step, Trace


@dataclass(frozen=True)
class ImageScene:
    """What an image-space method keeps of B images."""

    image: Tensor  # (B, 4, H, W): color in [-1, 1], depth [m]
    depth: Tensor  # (B, 2, H, W): depth with its holes filled [m], and 1 where it was measured
    intrinsics: Tensor  # (B, 3, 3) [px]
    context: ContextMap


@dataclass(frozen=True)
class RelevantScene(ImageScene):
    """The same, where the context also tells which regions matter."""

    relevance: Tensor  # (B, 1, h, w), the chance that the cell shows the object


class ImageSpace(PoseEstimator):
    """Observe images and read particles off them; the networks, and what their outputs mean, are
    injected.

    net: given the patch's size, how many extra numbers a particle is told and how many make a pose;
    bounds: how particles bound the object in the image; lessons: losses beside the chosen one, by
    name; stages: factors on all of them as training proceeds (null: 1 throughout); relevance:
    weight of the loss on the context's map, if it tells one; detach_position: whether what is read
    at a position has no gradient with respect to the displacement that led there; truncate: cut the gradient through
    places that are looked at, and through the latent, every so many steps (null: never), which
    changes no value. A place still hands its own gradient on to the next, so that over a long
    roll-out this damps the growth; only 1, a cut at every step, ends it.
    """

    provides: ClassVar[Capabilities] = (
        "displacement",
        "image_patches",
        "pixel_space",
        "rollout",
        "surface_points",
    )

    position_width: ClassVar[int] = 0  # numbers that tell a particle its own location
    net: Any
    glimpse: Any
    encoder: Any
    pose_head: Any
    displacement: Any

    def __init__(
        self,
        net: Callable[..., nn.Module],
        glimpse: IntegerCut | SmoothGlimpse,
        encoder: nn.Module,
        pose_head: nn.Module,
        displacement: nn.Module,
        box_head: BoxHead,
        aux_losses: Mapping[str, Auxiliary | None] | None = None,
        loss_schedule: Sequence[Stage] | None = None,
        relevance: float = 1.0,
        detach_position: bool = False,
        truncate: int | None = None,
        object_model: ObjectModel | None = None,
        **base: Any,
    ) -> None:
        super().__init__(**base)
        self.glimpse, self.encoder, self.pose_head, self.displacement = (
            glimpse,
            encoder,
            pose_head,
            displacement,
        )
        self.net = net(
            extra=self.encoder.width + self.position_width,
            size=glimpse.size,
            pose_width=self.pose_head.width,
        )
        self.box_head = box_head
        self.aux_losses = {name: aux for name, aux in (aux_losses or {}).items() if aux is not None}
        self.loss_schedule = tuple(loss_schedule or ())
        check_loss_schedule(self.loss_schedule, ["loss", "relevance", *(aux_losses or {})])
        for piece in (box_head, *(aux.loss for aux in self.aux_losses.values())):
            check_latent_width(self.latent_width, getattr(piece, "latent_width", None))
        self.relevance_weight, self.detach_position, self.truncate = (
            relevance,
            detach_position,
            truncate,
        )
        if object_model is not None:  # not in the base, where the pose code is not there yet
            self.set_object(object_model)

    @property
    def space(self) -> PixelSpace:
        """Return the image plane."""
        return PixelSpace()

    @property
    def latent_width(self) -> int:
        """Return L."""
        return int(self.net.latent_width)

    def encode(self, batch: Batch) -> ImageScene:
        """Encode the images once."""
        seen = self.encoder(batch.rgb, batch.depth, batch.intrinsics)
        image = torch.cat([batch.rgb * 2 - 1, batch.depth], dim=1)
        depth = torch.cat([fill_depth(batch.depth), (batch.depth > 0).to(batch.depth)], dim=1)
        if seen.relevance is None:
            return ImageScene(image, depth, batch.intrinsics, seen)
        return RelevantScene(
            image, depth, batch.intrinsics, seen, torch.sigmoid(seen.relevance)[:, None]
        )

    def measure(
        self, scene: ImageScene, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        """Look at each particle's patch and place, and tell likelihood, displacement, pose and
        latent.
        """
        state, latent = particles.state, particles.latent
        if self.truncate and step.number % self.truncate == 0:
            state, latent = state.detach(), latent.detach()
        if self.detach_position:
            state = state.detach()
        patch = self.image_patches(scene, state)
        extra = torch.cat(
            [
                self.encoder.sample_features(scene.context, state),
                self.position_features(scene, state),
            ],
            dim=-1,
        )
        predicted = self.net(patch, extra, latent)
        height, width = scene.image.shape[-2:]
        displacement = self.displacement(
            predicted.displacement, predicted.logit, state, width, height
        )
        pose, fragments = self.pose_head(predicted.pose, self.surface_points(scene, state)[0])
        return ParticleOutput(
            F.logsigmoid(predicted.logit), displacement, pose, predicted.latent, fragments
        )

    def surface_points(self, scene: ImageScene, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return each particle's camera point (B, N, 3) [m], and whether its depth was measured (B,
        N) bool.

        Depth is read at the particle's whole pixel: between pixels of two surfaces there is
        nothing. Off the frame it is the nearest pixel's, and not measured.
        """
        H, W = scene.depth.shape[-2:]
        corner = torch.tensor([W - 1, H - 1], device=state.device)
        pixel = nearest_pixel(state)
        inside = torch.minimum(pixel.clamp_min(0), corner)
        z, known = gather_pixels(scene.depth, inside).unbind(-1)
        return back_project(state.detach(), z, scene.intrinsics), (known > 0) & (
            inside == pixel
        ).all(-1)

    def image_patches(self, scene: ImageScene, state: Tensor) -> Tensor:
        """Return what particles see where they stand: (B, N, 2) [px] -> (B, N, 4, k, k), as `image`."""
        patches: Tensor = self.glimpse(scene.image, state)
        return patches

    def position_features(self, scene: ImageScene, state: Tensor) -> Tensor:
        """Return what a particle is told of its own place: (B, N, 0) nothing, or (B, N, 2) its
        location in [-1, 1].
        """
        if not self.position_width:
            # nothing to learn: else all that decided the place would be asked for zeros
            return state.detach()[..., :0]
        height, width = scene.image.shape[-2:]
        half = state.new_tensor([(width - 1) / 2, (height - 1) / 2])
        return (state / half - 1)[..., : self.position_width]

    def training_losses(self, batch: Batch, generator: Generator) -> dict[str, Tensor]:
        """Return the chosen loss, each lesson's and the context's, of one roll-out: one value an
        image each, weighted.
        """
        own = self.train_filter is not self.filter
        check_particle_counts(self.train_filter, "model.train_filter" if own else "filter")
        scene = self.encode(batch)
        trace: Trace = self.train_filter(batch, _EncodedMethod(self, scene), generator)
        losses = {"loss": self.loss(trace, batch, self.model)}
        for name, aux in self.aux_losses.items():
            losses[name] = aux.weight * aux.loss(trace, batch, self.model)
        if isinstance(scene, RelevantScene) and self.relevance_weight:
            losses["relevance"] = self.relevance_weight * relevance_loss(scene.context, batch.mask)
        factors = factors_at(self.loss_schedule, self.progress())
        return {name: factors.get(name, 1.0) * value for name, value in losses.items()}

    def progress(self) -> float:
        """Return the share of the training's steps that are done; 0 where no trainer counts them."""
        if self._trainer is None or not self.loss_schedule:
            return 0.0
        return self.global_step / max(1.0, float(self.trainer.estimated_stepping_batches))

    def set_object(self, model: ObjectModel) -> None:
        """Tell the pose code about the object, and watch for signs of failure beside the metrics."""
        super().set_object(model)
        self.pose_head.set_object(model)
        self.scores["diagnostics"] = FilterDiagnostics()

    def score(self, trace: Trace, batch: Batch) -> None:
        """Add a batch's errors, and its signs of failure."""
        super().score(trace, batch)
        cast(FilterDiagnostics, self.scores["diagnostics"]).update(trace, batch)

    def results(self) -> dict[str, Any]:
        """Return the metrics, and the signs of failure."""
        return super().results() | {
            "diagnostics": cast(FilterDiagnostics, self.scores["diagnostics"]).compute()
        }

    def box(self, trace: Trace, batch: Batch) -> Tensor:
        """Return how the particles bound the object, (B, 4) [px]."""
        return self.box_head(trace, batch, self.model)


class _EncodedMethod:
    """A method that has looked at its images already, so that a roll-out and a loss on the scene
    share one look.
    """

    def __init__(self, method: ImageSpace, scene: ImageScene) -> None:
        self.method, self.scene = method, scene
        self.space, self.latent_width, self.measure = (
            method.space,
            method.latent_width,
            method.measure,
        )
        self.surface_points, self.model = method.surface_points, method.model

    def encode(self, batch: Batch) -> ImageScene:
        """Return what was seen."""
        return self.scene


def check_latent_width(width: int, read: int | None) -> None:
    """Raise UserError unless a latent is as wide as a piece that reads it takes it to be (None: any)."""
    if read not in (None, width):
        raise UserError(
            f"model.net.latent_width={width}: model/box_head=votes needs {read}, one for each of "
            "the box's sides"
        )


def check_particle_counts(rolled: ParticleFilter, name: str) -> None:
    """Raise UserError unless a training roll-out's steps are of one size: losses judge them side by
    side.

    Args:
        rolled: The filter that is rolled out.
        name: What it is called in the settings.
    """
    if rolled.steps > 1 and rolled.first_particles != rolled.particles:
        raise UserError(
            f"{name}.first_particles={rolled.first_particles}: a training needs as many as "
            f"{name}.particles={rolled.particles}; choose {name}.first_particles=null or "
            f"model/train_rollout=truncated (evaluate.py takes any)"
        )


def relevance_loss(context: ContextMap, mask: Tensor) -> Tensor:
    """Cross-entropy of the map against whether its cells show the object, half of the weight on
    those that do.  -> (B,).
    """
    logit = context.relevance
    assert logit is not None
    shows = F.adaptive_max_pool2d(mask.float(), logit.shape[-2:])[:, 0]
    entropy = F.binary_cross_entropy_with_logits(logit, shows, reduction="none")
    on = (entropy * shows).sum((1, 2)) / shows.sum((1, 2)).clamp_min(1)
    off = (entropy * (1 - shows)).sum((1, 2)) / (1 - shows).sum((1, 2)).clamp_min(1)
    return (on + off) / 2
