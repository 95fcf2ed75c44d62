"""Base class of the four image-space methods: a particle is a pixel and sees the image around
it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Generator, Tensor, nn

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.filters.loop import ParticleFilter
from posefilter.geometry.camera import back_project
from posefilter.geometry.lookup import gather_pixels, nearest_inside, nearest_pixel
from posefilter.geometry.spaces import PixelSpace
from posefilter.models.base import PoseEstimator
from posefilter.models.box_heads import BoxHead
from posefilter.models.loss_schedule import Auxiliary, Stage, check_loss_schedule, loss_weights_at
from posefilter.models.zoom import with_encoding
from posefilter.nets.encoders import ContextMap
from posefilter.nets.glimpse import BilinearGlimpse, IntegerCut
from posefilter.nets.heads import fill_depth
from posefilter.types import Batch, ObjectModel, ParticleOutput, Particles, Step, Trace


class ImageEncoding(NamedTuple):
    """B encoded images."""

    image: Tensor  # (B, 4, H, W): color in [-1, 1], depth [m]
    depth: Tensor  # (B, 2, H, W): depth with its holes filled [m], and 1 where it was measured
    intrinsics: Tensor  # (B, 3, 3) [px]
    context: ContextMap
    # (B, 1, h, w), the probability that the cell shows the object; None where no encoder tells
    objectness: Tensor | None

    @property
    def measured_depth(self) -> Tensor:
        """The z-depth (B, H, W) [m]; 0 unknown."""
        return self.image[:, 3]

    @property
    def measured_color(self) -> Tensor:
        """Red, green and blue (B, 3, H, W) in [0, 1]."""
        return (self.image[:, :3] + 1) / 2


class ImageSpace(PoseEstimator):
    """A particle filter over pixels, with an injected network and output heads.

    Args:
        net: Builds the network from the patch's size, the number of extra inputs and the width of
            the pose output.
        glimpse: Crops the image patch at each particle.
        encoder: Computes feature maps of the whole image once; sampled at each particle.
        pose_head: Turns network outputs into a pose.
        displacement: Turns network outputs into a displacement [px].
        box_head: Computes the object's bounding box from the particles.
        aux_losses: Losses that are added to the chosen one, by name; None: switched off.
        loss_schedule: Factors on the losses as training proceeds; None: 1 throughout.
        objectness_weight: Weight of the loss on the encoder's objectness map, where it has one.
        detach_position: Block the gradient of what is seen at a position with respect to the
            displacement that led there.
        truncate: Truncate backpropagation through positions and latents at every so many steps;
            None: never. Values do not change. A position still passes its own gradient on to the
            next, so over a long roll-out this damps the growth of gradients; only 1 ends it.
        **base: Arguments of `PoseEstimator`.
    """

    provides: ClassVar[Capabilities] = (
        "color",
        "depth",
        "displacement",
        "image_patches",
        "pixel_space",
        "rollout",
        "surface_points",
    )

    position_width: ClassVar[int] = 0  # inputs that hold a particle's own position
    net: Any
    glimpse: Any
    encoder: Any
    pose_head: Any
    displacement: Any

    def __init__(
        self,
        net: Callable[..., nn.Module],
        glimpse: IntegerCut | BilinearGlimpse,
        encoder: nn.Module,
        pose_head: nn.Module,
        displacement: nn.Module,
        box_head: BoxHead,
        aux_losses: Mapping[str, Auxiliary | None] | None = None,
        loss_schedule: Sequence[Stage] | None = None,
        objectness_weight: float = 1.0,
        detach_position: bool = False,
        truncate: int | None = None,
        **base: Any,
    ) -> None:
        super().__init__(**base)
        self.glimpse = glimpse
        self.encoder = encoder
        self.pose_head = pose_head
        self.displacement = displacement
        extra = self.encoder.width + self.position_width
        self.net = net(extra=extra, size=glimpse.size, pose_width=self.pose_head.width)
        self.box_head = box_head
        self.aux_losses = {name: aux for name, aux in (aux_losses or {}).items() if aux is not None}
        self.loss_schedule = tuple(loss_schedule or ())
        check_loss_schedule(self.loss_schedule, ["loss", "objectness", *(aux_losses or {})])
        for component in (box_head, *(aux.loss for aux in self.aux_losses.values())):
            required = getattr(component, "latent_width", None)
            if required not in (None, self.latent_width):
                raise UserError(
                    f"model.net.latent_width={self.latent_width}: model/box_head=votes needs "
                    f"{required}, one for each of the box's sides"
                )
        self.objectness_weight = objectness_weight
        self.detach_position = detach_position
        self.truncate = truncate

    @property
    def space(self) -> PixelSpace:
        """The image plane."""
        return PixelSpace()

    @property
    def latent_width(self) -> int:
        """Width L of a particle's latent."""
        return int(self.net.latent_width)

    def encode(self, batch: Batch) -> ImageEncoding:
        """Encode the images."""
        context = self.encoder(batch.rgb, batch.depth, batch.intrinsics)
        image = torch.cat([batch.rgb * 2 - 1, batch.depth], dim=1)
        depth = torch.cat([fill_depth(batch.depth), (batch.depth > 0).to(batch.depth)], dim=1)
        logit = context.objectness
        objectness = None if logit is None else torch.sigmoid(logit)[:, None]
        return ImageEncoding(image, depth, batch.intrinsics, context, objectness)

    def measure(
        self, encoding: ImageEncoding, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        """Compute likelihood, displacement, pose and latent of each particle from what it sees."""
        state, latent = particles.state, particles.latent
        if self.truncate and step.number % self.truncate == 0:
            state, latent = state.detach(), latent.detach()
        if self.detach_position:
            state = state.detach()
        patch = self.image_patches(encoding, state)
        features = self.encoder.sample_features(encoding.context, state)
        extra = torch.cat([features, self.position_features(encoding, state)], dim=-1)
        predicted = self.net(patch, extra, latent)
        height, width = encoding.image.shape[-2:]
        displacement = self.displacement(
            predicted.displacement, predicted.logit, state, width, height
        )
        pose, fragments = self.pose_head(predicted.pose, self.surface_points(encoding, state)[0])
        return ParticleOutput(
            F.logsigmoid(predicted.logit), displacement, pose, predicted.latent, fragments
        )

    def surface_points(self, encoding: ImageEncoding, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return the measured point at each particle.

        Depth is taken at the nearest pixel, not interpolated: between the pixels of two surfaces
        there is no surface. A particle off the frame gets the depth of the nearest pixel in it.

        Args:
            encoding: Encoded images.
            state: (B, N, 2) particles [px].

        Returns:
            Points in the camera (B, N, 3) [m], and whether their depth was measured (B, N) bool.
        """
        inside = nearest_inside(state, *encoding.depth.shape[-2:])
        z, measured = gather_pixels(encoding.depth, inside).unbind(-1)
        return back_project(state.detach(), z, encoding.intrinsics), (measured > 0) & (
            inside == nearest_pixel(state)
        ).all(-1)

    def image_patches(self, encoding: ImageEncoding, state: Tensor) -> Tensor:
        """Crop the patch at each particle.  (B, N, 2) [px] -> (B, N, 4, k, k), channels as
        `image`.
        """
        return self.glimpse(encoding.image, state)

    def position_features(self, encoding: ImageEncoding, state: Tensor) -> Tensor:
        """Return a particle's own position as network input.

        (B, N, 2) [px] -> (B, N, 2) in [-1, 1] within the frame, or (B, N, 0) where the network does
        not take it.
        """
        if not self.position_width:
            # without gradient: the graph behind the positions would be traversed for nothing
            return state.detach()[..., :0]
        height, width = encoding.image.shape[-2:]
        half = state.new_tensor([(width - 1) / 2, (height - 1) / 2])
        return (state / half - 1)[..., : self.position_width]

    def training_losses(self, batch: Batch, generator: Generator) -> dict[str, Tensor]:
        """Return the weighted losses of one roll-out, by name.

        Returns:
            The chosen loss, the auxiliary losses and the objectness loss, (B,) each.
        """
        name = "filter" if self.train_rollout is self.filter else "model.train_rollout"
        check_particle_counts(self.train_rollout, name)
        encoding = self.encode(batch)
        trace: Trace = self.train_rollout(batch, with_encoding(self, encoding), generator)
        losses = {"loss": self.loss(trace, batch, self.object_model)}
        for name, aux in self.aux_losses.items():
            losses[name] = aux.weight * aux.loss(trace, batch, self.object_model)
        if encoding.objectness is not None and self.objectness_weight:
            losses["objectness"] = self.objectness_weight * objectness_loss(
                encoding.context, batch.mask
            )
        weights = loss_weights_at(self.loss_schedule, self.progress())
        return {name: weights.get(name, 1.0) * value for name, value in losses.items()}

    def progress(self) -> float:
        """Return the fraction of the training that is done, by its steps or by its time budget,
        whichever is more; 0 without a trainer or a schedule.
        """
        if self._trainer is None or not self.loss_schedule:
            return 0.0
        done = self.global_step / max(1.0, float(self.trainer.estimated_stepping_batches))
        return max(done, self.time_spent)

    def set_object(self, object_model: ObjectModel) -> None:
        """Set the object of the pose head too."""
        super().set_object(object_model)
        self.pose_head.set_object(object_model)

    def make_metrics(self) -> dict[str, nn.Module]:
        """Create the metrics, with the filter diagnostics."""
        from posefilter.metrics.diagnostics import FilterDiagnostics  # prediction needs none

        return super().make_metrics() | {"diagnostics": FilterDiagnostics()}

    def update_metrics(self, trace: Trace, batch: Batch) -> None:
        """Add a batch's errors and diagnostics."""
        super().update_metrics(trace, batch)
        self.scores["diagnostics"].update(trace, batch)

    def compute_metrics(self) -> dict[str, Any]:
        """Return the metrics, with the filter diagnostics."""
        return super().compute_metrics() | {"diagnostics": self.scores["diagnostics"].compute()}

    def box(self, trace: Trace, batch: Batch) -> Tensor:
        """Return the bounding box that the box head computes, (B, 4) [px]."""
        return self.box_head(trace, batch, self.object_model)


def check_particle_counts(rolled: ParticleFilter, name: str) -> None:
    """Raise UserError unless all steps of a training roll-out have the same number of particles,
    since losses stack the steps into one tensor; `name` is the filter's key in the settings.
    """
    if rolled.steps > 1 and rolled.initial_particles != rolled.particles:
        raise UserError(
            f"{name}.initial_particles={rolled.initial_particles}: training needs as many as "
            f"{name}.particles={rolled.particles}; choose {name}.initial_particles=null or "
            f"model/train_rollout=short (evaluate.py takes any)"
        )


def objectness_loss(context: ContextMap, mask: Tensor) -> Tensor:
    """Return the balanced binary cross-entropy of the objectness map, half of the weight on the
    cells that show the object.  Mask (B, 1, H, W) bool -> (B,).
    """
    logit = context.objectness
    assert logit is not None
    shows = F.adaptive_max_pool2d(mask.float(), logit.shape[-2:])[:, 0]
    entropy = F.binary_cross_entropy_with_logits(logit, shows, reduction="none")
    on = (entropy * shows).sum((1, 2)) / shows.sum((1, 2)).clamp_min(1)
    off = (entropy * (1 - shows)).sum((1, 2)) / (1 - shows).sum((1, 2)).clamp_min(1)
    return (on + off) / 2
