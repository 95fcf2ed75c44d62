"""The paper's fifth method: particles are poses, weighted by a learned likelihood."""

from contextlib import nullcontext
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Generator, Tensor, nn

from posefilter.capabilities import Capabilities
from posefilter.data.absent import hide_annotation
from posefilter.filters.traces import map_tensors
from posefilter.geometry.spaces import to_device
from posefilter.metrics.scores import InstanceErrors
from posefilter.models.base import SEEDS
from posefilter.models.candidate_samplers import CandidateSampler
from posefilter.models.pose_particles import PoseParticles, require_depth
from posefilter.nets.coordinates import Cells, Coordinates, coordinate_loss
from posefilter.nets.fused import applies, make_tables
from posefilter.nets.layers import fast_bfloat16
from posefilter.nets.likelihood import Pixels, Region, flatten_images
from posefilter.nets.pose_votes import draw_poses, measure_cells
from posefilter.nets.proposals import ObjectCoordinateNet
from posefilter.types import Batch, ObjectModel, ParticleOutput, Particles, Step, Trace

# images in which the estimate scores higher than the truth: all, those whose ADD is wrong, and
# those whose ADD-S is
_OUTSCORED = ("truth_outscored", "truth_outscored_by_wrong", "truth_outscored_by_misplaced")


class PoseEncoding(NamedTuple):
    """Encoded images: their pixels, and the output of the proposal network (None without one)."""

    image: Pixels
    coordinates: Coordinates | None
    cells: Cells | None

    @property
    def objectness(self) -> Tensor | None:
        """The probability that each cell shows the object, (B, 1, h, w); None without a network."""
        return None if self.coordinates is None else torch.sigmoid(self.coordinates.logit)[:, None]

    @property
    def measured_depth(self) -> Tensor:
        """The z-depth (B, H, W) [m]; 0 unknown."""
        return self.image.values[..., 3].unflatten(1, self.image.size)

    @property
    def measured_color(self) -> Tensor:
        """Red, green and blue (B, 3, H, W) in [0, 1]."""
        return self.image.values[..., :3].mT.unflatten(2, self.image.size)

    @property
    def intrinsics(self) -> Tensor:
        """The camera matrices (B, 3, 3) [px]."""
        return self.image.intrinsics

    def with_quasi_monte_carlo(self) -> "PoseEncoding":
        """Return the same images, whose poses are scored by points that are drawn evenly."""
        return self._replace(image=self.image._replace(even=True))


class PosePF(PoseParticles):
    """A particle filter over SE(3) with a learned likelihood.

    Args:
        likelihood: Scores poses (nets/likelihood.py, or the paper's).
        candidate_sampler: Draws the candidates that the likelihood is trained on.
        proposals: Network of dense object coordinates that initial poses are drawn from, or None.
        pixels: Image points that each pose is scored from, at each step of the filter.
        quasi_monte_carlo: Whether these are a low-discrepancy sequence, with less noise in the
            score, instead of independent draws (nets/quasi_monte_carlo.py). Training draws them
            independently.
        train_pixels: The same in training.
        likelihood_batch_size: Images of a batch that the likelihood is trained on; None: all. The
            proposal network, which needs more of them, is always trained on all.
        proposal_weight: Weight of the proposal network's loss.
        **base: Arguments of `PoseEstimator`.
    """

    provides: ClassVar[Capabilities] = ("color", "depth", "pose", "pose_space", "score_poses")
    # training rolls out no filter
    test_only_settings: ClassVar[tuple[str, ...]] = ("filter", "train_rollout", "pixels")
    test_only_settings += ("quasi_monte_carlo",)
    # for comparing the scores of estimate and truth: image points, noise level [m]
    comparison_pixels, comparison_sigma = 4096, 0.004

    def __init__(
        self,
        likelihood: nn.Module,
        candidate_sampler: CandidateSampler,
        proposals: ObjectCoordinateNet | None = None,
        pixels: int = 64,
        quasi_monte_carlo: bool = False,
        train_pixels: int = 48,
        likelihood_batch_size: int | None = None,
        proposal_weight: float = 1.0,
        **base: Any,
    ) -> None:
        super().__init__(**base)
        self.likelihood = likelihood
        self.proposals = proposals
        self.candidate_sampler = candidate_sampler
        self.pixels = pixels
        self.quasi_monte_carlo = quasi_monte_carlo
        self.train_pixels = train_pixels
        self.likelihood_batch_size = likelihood_batch_size
        self.proposal_weight = proposal_weight

    def encode(self, batch: Batch) -> PoseEncoding:
        """Flatten the images, and run the proposal network once."""
        even = self.quasi_monte_carlo and not self.training
        if self.proposals is None:
            image = flatten_images(batch.rgb, batch.depth, batch.intrinsics)
            return PoseEncoding(image._replace(even=even), None, None)
        coordinates = self.proposals(batch.rgb, batch.depth, batch.intrinsics)
        context = coordinates if coordinates.features.shape[-1] else None
        image = flatten_images(batch.rgb, batch.depth, batch.intrinsics, context)
        image = image._replace(even=even)
        if context is not None and applies(batch.rgb.device):
            assert image.context is not None
            image = image._replace(tables=make_tables(image.context))
        return PoseEncoding(image, coordinates, measure_cells(batch.depth, batch.intrinsics))

    def measure(
        self, encoding: PoseEncoding, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        """Score every particle at the step's noise level."""
        count = self.train_pixels if self.training else self.pixels
        score = self._score(encoding, particles.state, step.sigma, generator, count, fast=True)
        no_move = particles.state.new_zeros(*particles.state.shape[:2], self.space.dimensions)
        return ParticleOutput(score, no_move, particles.state, particles.latent)

    def score_poses(
        self, encoding: PoseEncoding, poses: Tensor, sigma: float, generator: Generator, pixels: int
    ) -> Tensor:
        """Score any poses at a noise level.

        Args:
            encoding: Encoded images.
            poses: (B, N, 4, 4) camera_from_object [m].
            sigma: Noise level [m].
            generator: Draws the image points.
            pixels: Image points that each pose is scored from.

        Returns:
            Log-likelihoods up to a constant for each image, (B, N).
        """
        at = poses.new_tensor(sigma)
        fast = not torch.is_grad_enabled()  # a gradient would be that of a rounded score
        return self._score(encoding, poses, at, generator, pixels, fast)

    def propose_poses(self, encoding: PoseEncoding, particles: int, generator: Generator) -> Tensor:
        """Draw poses from the votes of the proposal network.

        Returns:
            camera_from_object (B, particles, 4, 4) [m].

        Raises:
            UserError: An image has no depth.
        """
        assert encoding.coordinates is not None
        assert encoding.cells is not None
        if not self.training:
            require_depth(encoding.cells.valid)
        coordinates, size = (
            encoding.coordinates.detach(),
            (self._center(), self.object_model.radius),
        )
        return draw_poses(coordinates, encoding.cells, *size, particles, generator)

    def training_losses(self, batch: Batch, generator: Generator) -> dict[str, Tensor]:
        """Return the losses of likelihood and proposal network, one value for each image."""
        encoding = self.encode(batch)
        count = self.likelihood_batch_size or len(batch.rgb)
        subset = Batch(*(x[:count] for x in batch))
        image = encoding.image._replace(tables=None)  # whose rows are of all images
        subset_encoding = map_tensors(lambda x: x[:count], encoding._replace(image=image))
        candidates = self.candidate_sampler(self, subset_encoding, subset, generator)
        losses = {"likelihood": self.loss(candidates, subset, self.object_model)}
        if encoding.coordinates is not None and encoding.cells is not None:
            assert self.proposals is not None
            size = (self._center(), self.object_model.radius, float(self.proposals.reach))
            fit, error = coordinate_loss(
                encoding.coordinates, encoding.cells, batch.mask, batch.camera_from_object, *size
            )
            losses["proposals"] = self.proposal_weight * fit
            finite = error[error.isfinite()]
            if len(finite):
                self.log_scalar("coordinate_error_mm", 1000 * finite.mean())
        return losses

    def set_object(self, object_model: ObjectModel) -> None:
        """Set the object of the networks too."""
        super().set_object(object_model)
        surface = getattr(self.likelihood, "surface", None)
        if surface is not None:
            surface.set_object(object_model.points)

    def make_metrics(self) -> dict[str, nn.Module]:
        """Create the metrics, with a count of how often the truth is outscored."""
        from torchmetrics import MeanMetric  # prediction needs none

        counts = {name: MeanMetric() for name in _OUTSCORED}
        return super().make_metrics() | counts

    def update_metrics(self, trace: Trace, batch: Batch) -> None:
        """Add a batch's errors, and whether the estimate scores higher than the truth does.

        A refined estimate outscores the truth by a little even where it is right. The likelihood is
        at fault where an estimate does so and is wrong (ADD up to symmetry of 0.1 diameters or
        more), and beyond doubt where its ADD-S is as large: then no look-alike of the truth excuses
        it.
        """
        super().update_metrics(trace, batch)
        encoding = trace.encoding
        if encoding is None:
            encoding = self.encode(hide_annotation(batch))
        truth, best = batch.camera_from_object, trace.belief.best
        finite = best.isfinite().flatten(1).all(1)  # any other is a miss
        best = torch.where(finite[:, None, None], best, truth)
        pair = torch.stack([best, truth], dim=1)
        generator = torch.Generator(device=self.device).manual_seed(self.seed % SEEDS)
        sigma = pair.new_tensor(self.comparison_sigma)
        scores = self._score(encoding, pair, sigma, generator, self.comparison_pixels)
        outscored = finite & (scores[:, 0] > scores[:, 1])
        errors: InstanceErrors = self.scores["poses"].last()
        limit = 0.1 * errors.diameter
        wrong = outscored & (errors.add_up_to_symmetry > limit)
        misplaced = outscored & (errors.add_s > limit)
        for name, value in zip(_OUTSCORED, (outscored, wrong, misplaced), strict=True):
            self.scores[name].update(value.float())

    def compute_metrics(self) -> dict[str, Any]:
        """Return the metrics, with the fractions of images in which the truth was outscored."""
        out = super().compute_metrics()
        for name in _OUTSCORED:
            out["belief"][name] = float(self.scores[name].compute())
        return out

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Save the candidate sampler's state, so that a resumed run ends as one not interrupted.

        With several processes it is that of the first: the particles of the others' frames start
        anew.
        """
        super().on_save_checkpoint(checkpoint)
        checkpoint["candidate_sampler"] = self.candidate_sampler.state()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the candidate sampler's state; without one, particles start anew."""
        super().on_load_checkpoint(checkpoint)
        self.candidate_sampler.restore(checkpoint.get("candidate_sampler", {}))

    def _center(self) -> Tensor:
        return to_device(self.space.center, self.object_model.center.dtype, self.device)

    def _score(
        self,
        encoding: PoseEncoding,
        poses: Tensor,
        sigma: Tensor,
        generator: Generator,
        pixels: int,
        fast: bool = False,
        region: Region | None = None,
    ) -> Tensor:
        """Score poses, or a region of the object at them; if `fast`, in bfloat16 where that is
        fast: its error is far below the noise of few pixels.
        """
        bfloat16 = torch.autocast(
            self.device.type, torch.bfloat16, enabled=fast_bfloat16(self.device)
        )
        with bfloat16 if fast else nullcontext():
            size = (self._center(), self.object_model.radius)
            own = (pixels, generator) if region is None else (pixels, generator, region)
            score: Tensor = self.likelihood(encoding.image, poses, sigma, *size, *own)
        return score.float() if fast else score
