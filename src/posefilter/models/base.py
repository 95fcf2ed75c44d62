"""The base class of all methods: every Lightning hook, so that a method's own file is short.

A method predicts by itself. Lightning and torchmetrics, which train and test it, take seconds to
import, so that a method becomes a LightningModule only where that is needed: see `with_lightning`.

What a hook does stands beside it: metrics in evaluation.py, windows in zoom.py, clipping in
clipping.py, schedules in lr_schedulers.py, probabilities in posefilter/confidence.
"""

import itertools
import time
from collections.abc import Callable, Iterable
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import torch
from torch import Generator, Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from posefilter.capabilities import Capabilities, check_parts, collect_provided
from posefilter.confidence.belief_scale import calibrate_belief
from posefilter.confidence.calibration import Assessment, Calibration
from posefilter.confidence.features import measure_belief, measure_depth, measure_print
from posefilter.confidence.scale_ratio import ScaleRatio
from posefilter.confidence.second_look import look_again
from posefilter.confidence.tolerance import RIGHT
from posefilter.confidence.verdicts import Costs
from posefilter.data.absent import hide_annotation
from posefilter.errors import UserError
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.texture import LEARNED_PIXELS, LEARNED_SIGMA
from posefilter.geometry.camera import project
from posefilter.geometry.pose import origin_of
from posefilter.geometry.spaces import PoseSpace
from posefilter.metrics.results import compute_checkpoint_score, flatten, to_numbers
from posefilter.models import evaluation
from posefilter.models.box_heads import PoseBox
from posefilter.models.clipping import SubmoduleClipper
from posefilter.models.lr_schedulers import check_length, find_length, start_schedule
from posefilter.models.quantization import unpack_object
from posefilter.models.zoom import check_zoom, choose_part, search
from posefilter.nets import folded, fused
from posefilter.precision import check_precision
from posefilter.protocols import Loss, ScoresPoses, Space
from posefilter.types import Batch, BeliefBatch, ObjectModel, ParticleOutput, Particles, Step, Trace

if TYPE_CHECKING:
    from lightning import LightningModule as Module
else:
    Module = nn.Module  # `with_lightning` adds Lightning's

SEEDS = 1 << 63  # a generator takes smaller ones
_STAGES = {"train": 0, "validate": 1, "test": 2, "predict": 3}


class Trained(NamedTuple):
    """How far weights have been trained."""

    step: int
    epoch: int


class PoseEstimator(Module):
    """A method with its particle filter, loss and optimizer.

    By itself it predicts; `with_lightning` makes the LightningModule that a trainer runs.

    `set_object` must be called before any batch: metrics and heads depend on the object.

    Args:
        filter: Run in validation and test.
        loss: Given a training trace; returns one value for each image.
        optimizer: Given (name, parameter) pairs.
        scheduler: Given the optimizer, and the number of steps where it has a parameter for it
            (`lr_schedulers.LENGTHS`); advanced at each step.
        train_rollout: Rolled out in training; None: `filter`.
        seed: Decides every random draw, together with the epoch and the batch's number.
    """

    provides: ClassVar[Capabilities] = ("rollout",)
    requires: ClassVar[Capabilities] = ()
    _trainer: Any = None  # of the LightningModule
    # what makes probabilities of its features, and why there is none
    calibration: Calibration | None = None
    calibration_note: str = "the checkpoint is not calibrated (run calibrate)"
    costs = Costs()  # of errors, by which verdicts are chosen
    pose_tolerance = RIGHT  # what a right pose is, in the metrics of probabilities
    test_only_settings: ClassVar[tuple[str, ...]] = ()  # settings that training does not read

    def __init__(
        self,
        filter: ParticleFilter,
        loss: Loss,
        optimizer: Callable[[Iterable[tuple[str, nn.Parameter]]], Optimizer],
        scheduler: Callable[..., LRScheduler] | None = None,
        train_rollout: ParticleFilter | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.filter, self.train_rollout, self.loss = filter, train_rollout or filter, loss
        self.make_optimizer, self.make_scheduler, self.seed = optimizer, scheduler, seed
        if scheduler is not None:
            find_length(scheduler)  # a setting that is missing is told before the training begins
        self._object_model: ObjectModel | None = None
        self._first: tuple[nn.Module, ...] = ()  # the first module that has weights
        self._scores: Any = None  # made when they are first asked for
        self.seconds_per_image: list[float] = []  # one number for each image
        self.last_belief: BeliefBatch | None = None  # of the batch that the metrics took in last
        self.clipper = SubmoduleClipper()
        self.time_spent = 0.0  # share of the training's time budget, where it has one
        self.recipe: dict[str, Any] = {}  # how it was built: plain data, carried in its checkpoints
        self.tested_at: Trained | None = None  # of a checkpoint that is tested

    def set_object(self, object_model: ObjectModel) -> None:
        """Set the object, and forget the metrics of another.

        Raises:
            UserError: The method's components do not fit each other, see capabilities.py; or it has
                neither a pose nor a box of its own, or a network that its class hides.
        """
        for name in self._modules:
            if hasattr(type(self), name):  # which Python finds first
                raise UserError(
                    f"{type(self).__name__}: its network `{name}` is hidden by what the class has "
                    "under this name; give the network another name"
                )
        check_parts(self)
        check_zoom(self)
        if type(self).box is PoseEstimator.box and "pose" not in collect_provided(self):
            raise UserError(
                f"{type(self).__name__}: `provides` lacks pose, so that it needs a box() of its "
                "own, such as models/box_heads.py has: the default is the box of the pose"
            )
        self._object_model = object_model
        self._scores = None

    @cached_property
    def capabilities(self) -> frozenset[str]:
        """What the method and its components provide; metrics and figures are chosen by it."""
        return collect_provided(self)

    @property
    def object_model(self) -> ObjectModel:
        """The object.

        Raises:
            UserError: `set_object` has not been called.
        """
        if self._object_model is None:
            raise UserError(
                "the method has no object yet: give it data, or a checkpoint that holds one"
            )
        return self._object_model

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        # asked for many times a frame, and a search of all modules takes long
        for module in itertools.chain(self._first, self.modules()):
            for weight in module._parameters.values():
                if weight is not None:
                    self._first = self._first or (module,)
                    return weight.device
        return torch.device("cpu")

    def generator(self, stage: str, batch_number: int) -> Generator:
        """Return the random generator of a batch: a function of seed, stage, epoch and number; in
        training of the process's rank, too.
        """
        if stage == "train" and self._trainer is not None:
            batch_number = batch_number * self._trainer.world_size + self._trainer.global_rank
        epoch = getattr(self, "current_epoch", 0) if stage == "train" else 0
        seed = ((self.seed * 8 + _STAGES[stage]) * 100_003 + epoch) * 1_000_003 + batch_number
        return torch.Generator(device=self.device).manual_seed(seed % SEEDS)

    # -- what a method defines ---------------------------------------------------------------------

    @property
    def space(self) -> Space:
        """The space of the particles."""
        raise NotImplementedError(f"{type(self).__name__} must implement space")

    @property
    def latent_width(self) -> int:
        """L, the width of a particle's latent."""
        return 0

    def encode(self, batch: Batch) -> Any:
        """Encode the images; called once for each batch.

        Args:
            batch: B images. `mask` and `camera_from_object` must not be used: in training they are
                the truth, in validation and test there is nothing in them.

        Returns:
            What `measure` is given as `encoding`.
        """
        raise NotImplementedError(f"{type(self).__name__} must implement encode()")

    def measure(
        self, encoding: Any, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        """Compute likelihood, displacement, pose and latent of each particle.

        Args:
            encoding: Returned by `encode`.
            particles: N particles of each image.
            step: The step's number and noise level.
            generator: Source of randomness.
        """
        raise NotImplementedError(f"{type(self).__name__} must implement measure()")

    def box(self, trace: Trace, batch: Batch) -> Tensor:
        """Return the bounding box of the object's hull at the estimated pose, (B, 4) [px].

        A method without a pose has one of its own.
        """
        return PoseBox()(trace, batch, self.object_model)

    def particle_pixels(self, particles: Particles, batch: Batch) -> Tensor:
        """Return where particles are in the image, (B, N, 2) [px].

        A pose is where it puts the object's center.
        """
        if not isinstance(self.space, PoseSpace):
            return particles.state
        center = self.object_model.center.to(particles.state.device)
        return project(origin_of(particles.state, center), batch.intrinsics)

    def collect_features(
        self, trace: Trace, batch: Batch, margin: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Return what speaks for each estimate, by name.

        Args:
            trace: A finished run of the filter, or its last step alone.
            batch: Its B images; mask and pose are not used.
            margin: (B,) `rotation_margin` of earlier images of a track, which is then not measured.

        Returns:
            (B,) each; more of it speaks for the estimate.
        """
        best, object_model = trace.belief.best, self.object_model
        depth = measure_depth(best, batch, object_model)
        return {
            **measure_belief(trace.belief, object_model),
            **depth,
            **measure_print(
                best, batch, object_model, depth["surface"], margin, self._scorer(trace, batch)
            ),
        }

    def _scorer(self, trace: Trace, batch: Batch) -> Callable[[Tensor], Tensor] | None:
        """Return a function from poses to their learned log-likelihoods, as `TextureRotations` adds
        them; None where the method scores no poses.
        """
        if not isinstance(self, ScoresPoses):
            return None
        # the same image points each time: an estimate is as probable as before
        generator = torch.Generator(device=self.device).manual_seed(self.seed % SEEDS)

        def score(poses: Tensor) -> Tensor:
            encoding = self.encode(batch) if trace.encoding is None else trace.encoding
            return self.score_poses(encoding, poses, LEARNED_SIGMA, generator, LEARNED_PIXELS)

        return score

    def measure_scale_ratio(
        self, trace: Trace, batch: Batch, visible: Tensor | None = None
    ) -> ScaleRatio | None:
        """Return how large the object appears, relative to its mesh; None where the method cannot
        tell.

        Args:
            trace: As of `collect_features`.
            batch: Likewise.
            visible: (B, H, W) bool, the pixels that are the object's own; None: all that the method
                takes for it, as where an image shows one of it at most.
        """
        return None

    # -- prediction --------------------------------------------------------------------------------

    def predict_step(self, batch: Batch, batch_number: int) -> Trace:
        """Run the filter, again where its answer is doubtful (`look_again`); mask and pose of the
        batch are not used.
        """
        return self._run(batch, self.generator("predict", batch_number))

    def _run(self, batch: Batch, generator: Generator) -> Trace:
        batch = hide_annotation(batch)  # the truth is for the metrics alone
        return look_again(self, self.search(batch, generator), batch, generator)

    def search(self, batch: Batch, generator: Generator, encoding: Any = None) -> Trace:
        """Run the filter once, in a magnified window where the object is small (models/zoom.py).

        Args:
            batch: B images; mask and pose are not used.
            generator: Draws the particles.
            encoding: What `encode` returns of them, where it is known.
        """
        return search(self, batch, generator, encoding)

    def choose_part(self, image: Batch) -> Batch | None:
        """Return the part of one image in which the method is surest of the object when it sees it
        magnified; None where it cannot tell, or the particles are places in the image.
        """
        return choose_part(self, image) if "pose_space" in self.capabilities else None

    @torch.no_grad()
    def assess(self, trace: Trace, batch: Batch, margin: Tensor | None = None) -> Assessment | None:
        """Return the probabilities that the object is there and its pose right, None where the
        method is not calibrated; arguments as of `collect_features`.
        """
        if self.calibration is None:
            return None
        known = () if margin is None else (margin,)  # a method of one's own may take none
        features = self.collect_features(trace, batch, *known)
        return self.calibration.assess(features, self.pose_tolerance)

    def calibrate_belief(
        self, belief: BeliefBatch, assessment: Assessment | None, widening: float = 1.0
    ) -> tuple[BeliefBatch, Tensor | None]:
        """Return beliefs as wide as the errors of right estimates are (confidence/belief_scale.py).

        Args:
            belief: B beliefs, as the filter leaves them.
            assessment: What `assess` says of them; where it is None, or the calibration knows no
                scale, beliefs are returned as they are.
            widening: By how much the errors are larger than those of the calibrated filter.

        Returns:
            The beliefs; and of each, how many of the first poses are draws about the estimate,
            (B,), None where they are as they were.
        """
        if assessment is None or self.calibration is None or self.calibration.belief_scale is None:
            return belief, None
        features = assessment.features
        assert features is not None
        right = self.calibration.assess(features).probability  # within the default tolerance
        standardized = self.calibration.standardize(features)
        scale = self.calibration.belief_scale
        return calibrate_belief(belief, right, standardized, scale, self.object_model, widening)

    # -- training ----------------------------------------------------------------------------------

    def setup(self, stage: str) -> None:
        """Refuse a trainer of another precision, before anything is computed."""
        check_precision(self.trainer.precision)

    def on_train_start(self) -> None:
        """Refuse to go on for longer than the schedule that a checkpoint brings."""
        if self.make_scheduler is not None:
            check_length(self.make_scheduler, self.lr_schedulers(), self.trainer)

    def training_step(self, batch: Batch, batch_number: int) -> Tensor:
        """Return the sum of the losses' means, the loss that is minimized.

        It is logged as `train/loss`, its terms as `train/loss_<name>`: `train/loss_main` is that
        of the group `loss`.

        Raises:
            FloatingPointError: It is not finite.
        """
        losses = self.training_losses(batch, self.generator("train", batch_number))
        means = {name: value.mean() for name, value in losses.items()}
        total = torch.stack(list(means.values())).sum()
        if not bool(total.isfinite()):
            raise FloatingPointError(
                f"the loss is no longer finite: { ({k: v.item() for k, v in means.items()}) }"
            )
        for name, value in means.items():
            self.log_scalar(f"loss_{'main' if name == 'loss' else name}", value.detach())
        if self._trainer is not None:
            self.log("train/loss", total.detach(), prog_bar=True)
            self.log("train/learning_rate", self.trainer.optimizers[0].param_groups[0]["lr"])
        return total

    def training_losses(self, batch: Batch, generator: Generator) -> dict[str, Tensor]:
        """Return the losses by name, (B,) each; their sum is minimized.

        The default is the chosen loss of one roll-out.
        """
        trace = self.train_rollout(batch, self, generator)
        return {"loss": self.loss(trace, batch, self.object_model)}

    def log_scalar(self, name: str, value: Tensor) -> None:
        """Log a training scalar, if there is a trainer."""
        if self._trainer is not None:
            self.log(f"train/{name}", value)

    def configure_optimizers(self) -> Any:
        """Build the optimizer and its schedule over the run's steps."""
        named = ((name, p) for name, p in self.named_parameters() if p.requires_grad)
        optimizer = self.make_optimizer(named)
        if self.make_scheduler is None:
            return optimizer
        scheduler = start_schedule(self.make_scheduler, optimizer, self.trainer)
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
        """Clip the gradient of each submodule by its own norm (`SubmoduleClipper`).

        Raises:
            UserError: It is to be clipped in another way.
        """
        if gradient_clip_algorithm not in (None, "norm"):
            raise UserError(
                f"gradient_clip_algorithm={gradient_clip_algorithm}: gradients are clipped by the "
                "norm of each network; leave it out"
            )
        self.clipper.clip(self, gradient_clip_val, getattr(self, "global_step", 0))

    # -- validation and test -----------------------------------------------------------------------

    def validation_step(self, batch: Batch, batch_number: int) -> Trace:  # type: ignore[override]
        """Run the filter and update the metrics; callbacks are given the trace."""
        return self._evaluate(batch, "validate", batch_number)

    def test_step(self, batch: Batch, batch_number: int) -> Trace:  # type: ignore[override]
        """Run the filter and update the metrics; callbacks are given the trace."""
        return self._evaluate(batch, "test", batch_number)

    def _evaluate(self, batch: Batch, stage: str, batch_number: int) -> Trace:
        start = time.perf_counter()
        trace = self._run(batch, self.generator(stage, batch_number))
        trace.belief.best.cpu()  # waits for a GPU
        seconds = (time.perf_counter() - start) / len(batch.rgb)
        self.seconds_per_image += [seconds] * len(batch.rgb)
        self.update_metrics(trace, batch)
        return trace

    @property
    def scores(self) -> Any:
        """The metrics of the object by name, a ModuleDict; created at the first use."""
        if self._scores is None:
            self._scores = nn.ModuleDict(self.make_metrics()).to(self.device)
            for metric in self._scores.values():
                metric.distributed_available_fn = _has_all_images
        return self._scores

    def make_metrics(self) -> dict[str, nn.Module]:
        """Create the metrics of the object, by name."""
        return evaluation.make_metrics(self.object_model, self.capabilities)

    def update_metrics(self, trace: Trace, batch: Batch) -> None:
        """Add a batch's errors to the metrics."""
        self.last_belief = evaluation.update_metrics(self, trace, batch)

    def compute_metrics(self) -> dict[str, Any]:
        """Return the metrics since the last reset, nested as metrics.json has them."""
        return evaluation.compute_metrics(self)

    def collect_results(self) -> dict[str, Any]:
        """Return what `compute_metrics` does as plain numbers, as metrics.json holds them.

        Raises:
            UserError: A value is no number.
        """
        return dict(to_numbers(self.compute_metrics(), f"{type(self).__name__}.compute_metrics"))

    def train(self, mode: bool = True) -> Self:
        """Switch to training or evaluation."""
        _forget_cached_weights()
        return super().train(mode)

    def _reset(self) -> None:
        _forget_cached_weights()  # a callback may have changed weights through `.data`
        self.seconds_per_image = []
        for metric in self.scores.values():
            metric.reset()

    on_validation_epoch_start = on_test_epoch_start = _reset

    def on_validation_epoch_end(self) -> None:
        """Log the metrics; the best checkpoint has the highest `val/score`."""
        results = self._log_metrics("val")
        self.log("val/score", compute_checkpoint_score(results), prog_bar=True)

    def on_test_epoch_end(self) -> None:
        """Log the metrics."""
        self._log_metrics("test")

    @property
    def trained(self) -> Trained:
        """How far the weights have been trained: the trainer's count, unless a checkpoint is
        tested, which may be of an earlier step or of another run.
        """
        return self.tested_at or Trained(self.trainer.global_step, self.trainer.current_epoch)

    def _log_metrics(self, split: str) -> dict[str, Any]:
        """Log the metrics of a split, and return them.

        The logger is to put them at the step that the model has come to: by itself Lightning counts
        from 0, one less, and adds the epoch.
        """
        results = self.collect_results()
        for name, value in self.trained._asdict().items():
            self.log(name, float(value))
        self.log_dict({f"{split}/{name}": value for name, value in flatten(results).items()})
        return results

    # -- checkpoints -------------------------------------------------------------------------------

    def save_hyperparameters(self, *_: Any, **__: Any) -> None:
        """Refuse what Lightning would add to checkpoints: no command could read them.

        Raises:
            UserError: Always.
        """
        raise UserError(
            f"{type(self).__name__}: calls save_hyperparameters(), and no command could read its "
            "checkpoints; leave it out, since their recipe holds the settings"
        )

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Save the object and the recipe, as plain tensors, numbers and strings."""
        checkpoint["recipe"] = self.recipe
        checkpoint["object_model"] = dict(self.object_model._asdict())
        checkpoint["state_dict"] = {
            k: v for k, v in checkpoint["state_dict"].items() if not k.startswith("_scores.")
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Set the object that the checkpoint holds."""
        self.set_object(unpack_object(checkpoint["object_model"]))


def _forget_cached_weights() -> None:
    for cache_of_weights in (folded.CACHE, fused.CACHE):
        cache_of_weights.clear()


def _has_all_images() -> bool:
    """Tell metrics not to add up those of other processes: each validates and tests on all."""
    return False


@cache
def with_lightning(kind: type[PoseEstimator]) -> type[PoseEstimator]:
    """Return a method's class as a LightningModule, for `Trainer.fit` and `Trainer.test`.

    It has the same name, the same settings and the same keys of weights.
    """
    from lightning import LightningModule  # takes seconds: prediction needs none

    if issubclass(kind, LightningModule):
        return kind

    def reduce(method: Any, protocol: Any) -> Any:
        """Pickle by the class without Lightning: by this one's name that one is found."""
        if type(method) is not made:  # a class of one's own made of this one
            return object.__reduce_ex__(method, protocol)
        return _make_empty, (kind,), method.__getstate__()

    def load(cls: Any, checkpoint_path: Any, *args: Any, **kwargs: Any) -> Any:
        """Load as Lightning does: the settings have to be given."""
        try:
            return super(made, cls).load_from_checkpoint(checkpoint_path, *args, **kwargs)
        except TypeError as error:
            raise UserError(
                f"{checkpoint_path}: load_from_checkpoint needs all settings of {cls.__name__}; "
                "posefilter.load_method(path) takes them from the checkpoint"
            ) from error

    own = {name: getattr(kind, name) for name in ("__module__", "__qualname__", "__doc__")}
    own |= {"__reduce_ex__": reduce, "load_from_checkpoint": classmethod(load)}
    made: Any = type(kind.__name__, (kind, LightningModule), own)
    return made


def _make_empty(kind: Any) -> PoseEstimator:
    """Return a LightningModule of a method's class, as yet without any attribute."""
    made = with_lightning(kind)
    return made.__new__(made)
