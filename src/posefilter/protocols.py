"""The protocols of the filter on one page.  Each verb of the filter is one injected component; a
Hydra group chooses which.

DataModule -> Batch -> method.encode -> [measure -> reweight -> resample -> propagate] x
steps -> estimate -> refine -> BeliefBatch

The order on this page is the order in which filters/loop.py calls them.  Elsewhere are

- readers: `BaseReader` in data/readers/base.py; augmentations: `Augment` in data/augmentation.py;
- pose_pf's candidate samplers: `CandidateSampler` in models/candidate_samplers.py, with
  `ScoresSamples`; its likelihoods: `PoseLikelihood` in nets/likelihood.py;
- the displacements of the methods that see patches: `Displacement` in nets/heads.py; box heads:
  `BoxHead` in models/box_heads.py;
- encodings with object coordinates: `HasCoordinates` in nets/coordinates.py; likelihoods of points
  that a figure shows: `ScoresPoints` in callbacks/fields.py.
"""

from typing import Any, Protocol, runtime_checkable

from torch import Generator, Tensor

from posefilter.types import (
    Batch,
    BeliefBatch,
    ObjectModel,
    ParticleOutput,
    Particles,
    Resampled,
    Step,
    Trace,
)

Encoding = Any  # a method's encoded images: nothing, a pyramid, a feature map, proposals


class Space(Protocol):
    """The space of the particles."""

    @property
    def dimensions(self) -> int:
        """Return the width of a tangent vector."""

    def move(self, state: Tensor, tangent: Tensor) -> Tensor:
        """Return states shifted by tangent vectors, the exponential map of the space.

        (*, *S), (*, D) -> (*, *S).
        """

    def noise_scale(self, sigma: Tensor) -> Tensor:
        """Return the standard deviation an axis of a move of size sigma.  (*) -> (*, D)."""

    def mean(self, state: Tensor, weights: Tensor) -> Tensor:
        """Return the weighted mean of states.  (*, N, *S), (*, N) -> (*, *S)."""

    def distance(self, a: Tensor, b: Tensor) -> Tensor:
        """Return a distance in the space's unit.  (*, *S) x 2 -> (*)."""


class Method(Protocol):
    """A way to turn an image and a particle into a likelihood, a pose and a displacement."""

    @property
    def space(self) -> Space:
        """Return the space this method's particles live in."""

    @property
    def latent_width(self) -> int:
        """Return L, the width of a particle's latent (0 for none)."""

    def encode(self, batch: Batch) -> Encoding:
        """Encode the images.  Must not use `batch.mask` or `batch.camera_from_object`, which are
        blank in validation and test.
        """

    def measure(
        self, encoding: Encoding, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        """Measure every particle against the image."""


@runtime_checkable
class ScoresPoses(Protocol):
    """A method that can score any poses; required by refinement."""

    def score_poses(
        self, encoding: Encoding, poses: Tensor, sigma: float, generator: Generator, pixels: int
    ) -> Tensor:
        """Score (B, N, 4, 4) at noise level sigma, from `pixels` image points each -> (B, N),
        differentiable in poses.
        """


@runtime_checkable
class ProposesPoses(Protocol):
    """A method that can draw likely poses; required by `filter/initialize=from_proposals`."""

    def propose_poses(self, encoding: Encoding, particles: int, generator: Generator) -> Tensor:
        """Return (B, particles, 4, 4) camera_from_object."""


@runtime_checkable
class HasObject(Protocol):
    """A method that was given its object."""

    @property
    def object_model(self) -> ObjectModel:
        """The object."""


@runtime_checkable
class HasSurfacePoints(HasObject, Protocol):
    """A method whose particles each have a measured point; required by
    `filter/estimate=agreement`.
    """

    def surface_points(self, encoding: Encoding, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return each particle's camera point (B, N, 3) [m], and whether its depth was measured (B,
        N) bool.
        """


@runtime_checkable
class HasImagePatches(Protocol):
    """A method whose particles each see a patch of the image; required by figures of glimpses."""

    def image_patches(self, encoding: Encoding, state: Tensor) -> Tensor:
        """Return what particles (B, N, 2) [px] see: (B, N, C, k, k), color in [-1, 1] first."""


@runtime_checkable
class HasObjectness(Protocol):
    """An encoding with an objectness map; required by `filter/initialize=from_objectness`."""

    @property
    def objectness(self) -> Tensor:
        """The objectness of each cell, (B, 1, h, w) >= 0; cells cover the image evenly."""


@runtime_checkable
class HasDepth(Protocol):
    """An encoding that keeps the measured depth; required by refinement that aligns with it."""

    @property
    def measured_depth(self) -> Tensor:
        """The z-depth (B, H, W) [m]; 0 unknown."""

    @property
    def intrinsics(self) -> Tensor:
        """The camera matrices (B, 3, 3) [px]."""


@runtime_checkable
class HasColor(HasDepth, Protocol):
    """An encoding that keeps the image's colors too; required to compare them with a texture."""

    @property
    def measured_color(self) -> Tensor:
        """Red, green and blue (B, 3, H, W) in [0, 1]."""


class Schedule(Protocol):
    """Set the noise level of each step."""

    def __call__(self, steps: int) -> list[float]:
        """Return sigma for each of the steps."""


class Initialize(Protocol):
    """Draw the first particles' states."""

    def __call__(
        self, batch: Batch, encoding: Encoding, method: Method, particles: int, generator: Generator
    ) -> Tensor:
        """Return states (B, N, *S)."""


class Reweight(Protocol):
    """Turn likelihoods into weights."""

    def __call__(
        self, log_weights: Tensor, log_likelihood: Tensor, ancestor_log_likelihood: Tensor
    ) -> Tensor:
        """Return log weights (B, N); their log-sum-exp is the step's log evidence.

        The caller normalizes them.

        Args:
            log_weights: (B, N), normalized, before the step.
            log_likelihood: (B, N) of this step.
            ancestor_log_likelihood: (B, N) log-likelihood of each particle's ancestor at the step
                before; zeros at the first.
        """


class Resample(Protocol):
    """Draw ancestors from weighted particles."""

    def __call__(
        self, particles: Particles, count: int, space: Space, generator: Generator
    ) -> Resampled:
        """Draw `count` ancestors of each image (B, count), with the normalized log weights of the
        resampled particles.
        """


class Propagate(Protocol):
    """Move resampled particles."""

    def __call__(
        self, state: Tensor, displacement: Tensor, step: Step, space: Space, generator: Generator
    ) -> Tensor:
        """(B, N, *S), learned displacement (B, N, D) -> moved states (B, N, *S)."""


class Estimate(Protocol):
    """Choose one pose of the weighted particles.

    An attribute `score_is` says in words what its score is; `pose.json` repeats it.
    """

    def __call__(
        self,
        particles: Particles,
        output: ParticleOutput,
        encoding: Encoding,
        method: Method,
        generator: Generator,
    ) -> BeliefBatch:
        """Return the belief of the last particles."""


class Refine(Protocol):
    """Work on a belief after the last step: on its estimate, or on its particles.

    Some replace the estimate `best` and its `score` by better ones (rescoring, mean shift, gradient
    ascent), or the estimate alone (ICP), and leave the particles. Others replace the particles and
    weights (importance sampling, resample-move) and leave the estimate. One that scores the
    estimate anew says in `score_is` what the score then is.
    """

    def __call__(
        self, belief: BeliefBatch, encoding: Encoding, method: Method, generator: Generator
    ) -> BeliefBatch:
        """Return the belief with another estimate, or with other particles."""


class Label(Protocol):
    """Compute the training target of each particle."""

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return a target for each particle of each step, (T, B, N) or (T, B, N, D)."""


class Loss(Protocol):
    """A loss of a roll-out of the filter, or of scored candidates."""

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return one value an image, (B,)."""
