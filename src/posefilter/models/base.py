"""What every method shares as a LightningModule: every Lightning hook lives here, so that a
method's own file is short.
"""

import logging
import math
import time
from collections.abc import Callable, Iterable
from functools import cached_property
from typing import Any, ClassVar

import torch
from lightning import LightningModule
from torch import Generator, Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from posefilter.capabilities import Capabilities, check_parts, collect_provided
from posefilter.errors import UserError
from posefilter.filters.loop import ParticleFilter
from posefilter.geometry.boxes import box_of_pose
from posefilter.geometry.camera import project
from posefilter.geometry.pose import origin_of
from posefilter.geometry.spaces import PoseSpace
from posefilter.metrics.bop import BopErrors
from posefilter.metrics.collect import BeliefQuality, BoxIoU, ParticlesOnObject, PoseErrors
from posefilter.metrics.scores import overall
from posefilter.metrics.visibility import ErrorsByVisibility
from posefilter.protocols import Loss, Space
from posefilter.types import Batch, ObjectModel, ParticleOutput, Particles, Step, Trace

log = logging.getLogger(__name__)
_PATIENCE = 20  # steps
_STAGES = {"train": 0, "validate": 1, "test": 2, "predict": 3}


class PoseEstimator(LightningModule):
    """A method, the filter that runs it, and the loss it learns from.

    filter: run at validation and test; train_filter: rolled out in training where that differs;
    loss: judges a training trace, one value an image; optimizer: given (name, parameter) pairs;
    scheduler: given the optimizer and the number of steps, advanced each step; seed: with the epoch
    and the batch's number it decides every random draw. Which object it is about, `set_object`
    tells.
    """

    provides: ClassVar[Capabilities] = ("rollout",)
    requires: ClassVar[Capabilities] = ()
    test_only_settings: ClassVar[tuple[str, ...]] = ()  # settings that training does not read

    def __init__(
        self,
        filter: ParticleFilter,
        loss: Loss,
        optimizer: Callable[[Iterable[tuple[str, nn.Parameter]]], Optimizer],
        scheduler: Callable[[Optimizer, int], LRScheduler] | None = None,
        train_filter: ParticleFilter | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.filter, self.train_filter, self.loss = filter, train_filter or filter, loss
        self.make_optimizer, self.make_scheduler, self.seed = optimizer, scheduler, seed
        self._object_model: ObjectModel | None = None
        self.scores: Any = nn.ModuleDict()  # of metrics, which torch cannot tell from other modules
        self.seconds_per_image: list[float] = []
        self.lost = self.skipped_in_a_row = 0  # steps whose gradient was not finite
        self.recipe: dict[str, Any] = {}  # how it was built: plain data, carried in its checkpoints

    @cached_property
    def capabilities(self) -> frozenset[str]:
        """Return what the method and its pieces provide: metrics and figures go by it."""
        return collect_provided(self)

    @property
    def space(self) -> Space:
        """Return where particles live."""
        raise NotImplementedError(f"{type(self).__name__} must say where its particles live")

    @property
    def latent_width(self) -> int:
        """Return L, the width of a particle's latent."""
        return 0

    def encode(self, batch: Batch) -> Any:
        """Look at the images once."""
        raise NotImplementedError(f"{type(self).__name__} must say what it keeps of an image")

    def measure(
        self, scene: Any, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        """Judge every particle of a cloud."""
        raise NotImplementedError(f"{type(self).__name__} must say what it makes of a particle")

    @property
    def model(self) -> ObjectModel:
        """Return what the method knows of its object.  Raises UserError before it was told."""
        if self._object_model is None:
            raise UserError(
                "the method does not know its object yet: give it data, or a "
                "checkpoint that holds one"
            )
        return self._object_model

    def set_object(self, model: ObjectModel) -> None:
        """Learn which object it is about, and make the metrics for it.

        Raises:
            UserError: Its parts do not fit each other (see `capabilities`).
        """
        check_parts(self)
        self._object_model = model
        self.scores = nn.ModuleDict({"iou": BoxIoU(), "particles_on_object": ParticlesOnObject()})
        if "pose" in self.capabilities:
            self.scores["poses"] = PoseErrors([model])
            self.scores["bop"] = BopErrors([model])
            self.scores["by_visibility"] = ErrorsByVisibility([model])
            self.scores["belief"] = BeliefQuality([model])

    def generator(self, stage: str, batch_number: int) -> Generator:
        """Return the generator of one batch: it depends on seed, stage, epoch and number alone."""
        epoch = self.current_epoch if stage == "train" else 0
        seed = ((self.seed * 8 + _STAGES[stage]) * 100_003 + epoch) * 1_000_003 + batch_number
        return torch.Generator(device=self.device).manual_seed(seed % (1 << 63))

    # -- training ---------------------------------------------------------------------------------

    def training_losses(self, batch: Batch, generator: Generator) -> dict[str, Tensor]:
        """Return the losses by name, (B,) each; their sum is minimized.

        Here: the chosen one, of one roll-out.
        """
        return {"loss": self.loss(self.train_filter(batch, self, generator), batch, self.model)}

    def training_step(self, batch: Batch, batch_number: int) -> Tensor:
        """Return the sum of the losses' means."""
        losses = self.training_losses(batch, self.generator("train", batch_number))
        means = {name: value.mean() for name, value in losses.items()}
        total = torch.stack(list(means.values())).sum()
        if not bool(total.isfinite()):
            raise FloatingPointError(
                f"the loss is no longer finite: { ({k: v.item() for k, v in means.items()}) }"
            )
        for name, value in means.items():
            self.log_scalar(name, value.detach())
        if self._trainer is not None:
            self.log("train/total", total.detach(), prog_bar=True)
            self.log("train/learning_rate", self.trainer.optimizers[0].param_groups[0]["lr"])
        return total

    def log_scalar(self, name: str, value: Tensor) -> None:
        """Log a training scalar, where a trainer listens."""
        if self._trainer is not None:
            self.log(f"train/{name}", value)

    def configure_optimizers(self) -> Any:
        """Build the optimizer and its schedule over the run's steps."""
        optimizer = self.make_optimizer(
            (name, p) for name, p in self.named_parameters() if p.requires_grad
        )
        if self.make_scheduler is None:
            return optimizer
        scheduler = self.make_scheduler(optimizer, int(self.trainer.estimated_stepping_batches))
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": scheduler, "interval": "step"},
        }

    def configure_gradient_clipping(
        self,
        optimizer: Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip each part's gradient by its own norm: a wild step of one network must not shrink
        another's.

        A part whose gradient's norm is not finite is left as it is by this step, with a warning;
        also where nothing is clipped. Raises FloatingPointError after 20 such steps in a row, of
        any part, since no more would be learned.
        """
        lost = []
        for name, part in self.named_children():
            parameters = [p for p in part.parameters() if p.grad is not None]
            if parameters and not bool(
                nn.utils.clip_grad_norm_(parameters, gradient_clip_val or math.inf).isfinite()
            ):
                lost.append(name)
                for parameter in parameters:
                    parameter.grad = None  # zeros would still move it, by momentum
        self.lost += bool(lost)
        self.skipped_in_a_row = self.skipped_in_a_row + 1 if lost else 0
        if lost and self.lost in (1, 10, 100, 1000, 10_000):
            at = self.global_step
            log.warning(
                "step %d does not teach %s, the %d. so far: its gradient is not finite",
                at,
                ", ".join(lost),
                self.lost,
            )
        if self.skipped_in_a_row == _PATIENCE:
            raise FloatingPointError(
                f"the gradient of {', '.join(lost)} was not finite in {_PATIENCE} steps in a row: "
                f"a roll-out's can grow "
                "with each step; choose model.detach_position=true or "
                "model/train_rollout=truncated (image space), or fewer filter.steps"
            )

    # -- validation and test ----------------------------------------------------------------------

    def validation_step(self, batch: Batch, batch_number: int) -> Trace:  # type: ignore[override]  # callbacks look at it
        """Run the filter and collect its errors."""
        return self._judge(batch, "validate", batch_number)

    def test_step(self, batch: Batch, batch_number: int) -> Trace:  # type: ignore[override]
        """Run the filter and collect its errors; callbacks write the belief down."""
        return self._judge(batch, "test", batch_number)

    def predict_step(self, batch: Batch, batch_number: int) -> Trace:
        """Run the filter; mask and pose of the batch are not looked at."""
        return self.filter(batch, self, self.generator("predict", batch_number))

    def _judge(self, batch: Batch, stage: str, batch_number: int) -> Trace:
        start = time.perf_counter()
        trace: Trace = self.filter(batch, self, self.generator(stage, batch_number))
        self.seconds_per_image.append((time.perf_counter() - start) / len(batch.rgb))
        self.score(trace, batch)
        return trace

    def score(self, trace: Trace, batch: Batch) -> None:
        """Add a batch's errors to the metrics."""
        height, width = batch.rgb.shape[-2:]
        truth = box_of_pose(
            batch.camera_from_object, self.model.hull, batch.intrinsics, height, width
        )
        self.scores["iou"].update(self.box(trace, batch), truth)
        self.scores["particles_on_object"].update(
            batch.mask, self.particle_pixels(trace.particles[-1], batch)
        )
        if "poses" in self.scores:
            self.scores["poses"].update(trace.belief.best, batch.camera_from_object)
            self.scores["bop"].update(
                trace.belief.best, batch.camera_from_object, batch.intrinsics, width
            )
            self.scores["by_visibility"].collect(
                trace.belief.best, batch.camera_from_object, batch.visibility
            )
            self.scores["belief"].update(trace.belief, batch.camera_from_object)

    def box(self, trace: Trace, batch: Batch) -> Tensor:
        """Return the bounding box that the run ends with, (B, 4) [px]: where the estimate puts the
        object's hull.
        """
        height, width = batch.rgb.shape[-2:]
        return box_of_pose(trace.belief.best, self.model.hull, batch.intrinsics, height, width)

    def particle_pixels(self, particles: Particles, batch: Batch) -> Tensor:
        """Return where in the image particles are, (B, N, 2) [px]: a pose is where it puts the
        object's center.
        """
        if not isinstance(self.space, PoseSpace):
            return particles.state
        return project(
            origin_of(particles.state, self.model.center.to(particles.state.device)),
            batch.intrinsics,
        )

    def results(self) -> dict[str, Any]:
        """Return what was collected since the last reset, in the form of metrics.json."""
        out: dict[str, Any] = {"instances": 0, "missed": 0}
        out |= dict.fromkeys(("add", "add_s", "mssd", "mspd"))
        if "poses" in self.scores:
            out |= self.scores["poses"].compute() | self.scores["bop"].compute()
        else:
            out["instances"] = int(self.scores["iou"].count)
        for name in ("iou", "particles_on_object"):
            out[name] = float(self.scores[name].compute())
        times = self.seconds_per_image
        out["seconds_per_image"] = sum(times) / len(times) if times else None
        out["belief"] = self.scores["belief"].compute() if "poses" in self.scores else None
        out["by_visibility"] = (
            self.scores["by_visibility"].compute() if "poses" in self.scores else None
        )
        return out

    def _reset(self) -> None:
        self.seconds_per_image = []
        for metric in self.scores.values():
            metric.reset()

    def on_validation_epoch_start(self) -> None:
        """Forget what was collected before."""
        self._reset()

    def on_test_epoch_start(self) -> None:
        """Forget what was collected before."""
        self._reset()

    def on_validation_epoch_end(self) -> None:
        """Log the metrics; `val/score` is what the best checkpoint has most of."""
        results = self.results()
        self.log_dict({f"val/{name}": value for name, value in flatten(results).items()})
        self.log("val/score", compute_checkpoint_score(results), prog_bar=True)

    def on_test_epoch_end(self) -> None:
        """Log the metrics."""
        self.log_dict({f"test/{name}": value for name, value in flatten(self.results()).items()})

    # -- checkpoints ------------------------------------------------------------------------------

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Carry the object along, as plain tensors, numbers and strings."""
        checkpoint["recipe"] = self.recipe
        checkpoint["object_model"] = dict(self.model._asdict())
        checkpoint["state_dict"] = {
            k: v for k, v in checkpoint["state_dict"].items() if not k.startswith("scores.")
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take the object from the checkpoint."""
        self.set_object(ObjectModel(**checkpoint["object_model"]))


def compute_checkpoint_score(results: dict[str, Any]) -> float:
    """Return the one figure of results in the form of metrics.json (see `overall`)."""
    auc = float(results["add"]["auc"]) if results["add"] else None
    return overall(auc, float(results["particles_on_object"] or 0.0), float(results["iou"]))


def flatten(results: dict[str, Any], prefix: str = "") -> dict[str, float]:
    """Return nested numbers under joined names, those that are not numbers (or are None) left out."""
    out: dict[str, float] = {}
    for name, value in results.items():
        if isinstance(value, dict):
            out |= flatten(value, f"{prefix}{name}/")
        elif isinstance(value, int | float):
            out[prefix + name] = float(value)
    return out
