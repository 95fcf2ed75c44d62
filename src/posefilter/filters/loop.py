"""The particle filter that every method shares.

The algorithm is the bootstrap filter of Gordon, Salmond and Smith (1993), in the general form of
Doucet and Johansen (2009, section 4) and Chopin and Papaspiliopoulos (2020, chapter 10):

    encoding = encode(image)
    x[1], w[1] = initialize(N), 1 / N
    for t = 1 ... T:
        if t > 1:
            a = resample(w, N)                       ancestors
            x[t] = propagate(x[t - 1][a])
        g = measure(encoding, x[t])                     log-likelihood, displacement, pose, latent
        w[t] = normalize(reweight(w, g))
    belief = refine(estimate(x[T], w[T]))

Each verb is one component that is passed in; posefilter/protocols.py defines them all. Here t is an
iteration over one image, or the next image of a sequence. The log of the weights' sum before they
are normalized is the step's log evidence; with sequential weights their total estimates log p(y).

References:
    Gordon, Salmond, Smith: Novel approach to nonlinear/non-Gaussian Bayesian state estimation.
        IEE Proceedings F 140 (1993).
    Doucet, Johansen: A tutorial on particle filtering and smoothing: fifteen years later. Handbook
        of Nonlinear Filtering (2009).
    Chopin, Papaspiliopoulos: An Introduction to Sequential Monte Carlo. Springer (2020).
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Generator, Tensor, nn

from posefilter import cuda_graphs
from posefilter.capabilities import list_parts, read_declared
from posefilter.errors import UserError
from posefilter.filters.auxiliary import bind_to_encoding
from posefilter.protocols import (
    Encoding,
    Estimate,
    Initialize,
    Method,
    Propagate,
    Refine,
    Resample,
    Reweight,
    Schedule,
    Space,
)
from posefilter.types import Batch, ParticleOutput, Particles, Resampled, Step, Trace

MAX_SEARCHES = 3  # of an image, where nothing else is set
_find_recording = cuda_graphs.make_recordings()


class Iteration(NamedTuple):
    """What one step of the filter leaves."""

    particles: Particles  # weighted by what the step measured
    output: ParticleOutput
    step: Step
    log_evidence: Tensor  # (B,) log of the weights' sum before they were normalized


class ParticleFilter(nn.Module):
    """A particle filter: measure, reweight, resample and propagate weighted particles.

    It keeps no tensor between calls, and all randomness comes from the generator of the call. The
    belief is differentiable in likelihoods and displacements as far as the chosen components are.

    Args:
        particles: Number of particles, N.
        steps: Number of measurements, T.
        initialize: Draws the first states.
        schedule: Gives each step's noise level.
        reweight: Turns likelihoods into weights.
        resample: Draws ancestors.
        propagate: Moves the resampled states.
        estimate: Chooses one pose of the last particles.
        refine: Improves the estimate, or replaces the particles.
        initial_particles: Number of particles at the first step; `particles` if None.
        max_searches: How often an image is searched at most, while a calibrated answer is doubtful
            (confidence/second_look.py); 1 to 4.
        magnified_width: The object's diameter, in widths of the image, in a magnified window, which
            a method that estimates poses searches where it is less than that / 1.2 in the image
            (models/zoom.py); None: nowhere.

    The filter does not read the last two: it runs once, on the images that it is given. They say
    how often, and on which windows, `PoseEstimator` runs it in validation, test and prediction.
    They are arguments of the filter since the recipes of checkpoints hold them with its own.

    Raises:
        UserError: A number is below 1, `max_searches` above 4, or `magnified_width` not in (0, 1].
    """

    def __init__(
        self,
        particles: int,
        steps: int,
        initialize: Initialize,
        schedule: Schedule,
        reweight: Reweight,
        resample: Resample,
        propagate: Propagate,
        estimate: Estimate,
        refine: Refine,
        initial_particles: int | None = None,
        max_searches: int = MAX_SEARCHES,
        magnified_width: float | None = None,
    ) -> None:
        super().__init__()
        first = particles if initial_particles is None else initial_particles
        if min(particles, steps, first) < 1:
            raise UserError(
                f"filter: particles={particles}, initial_particles={initial_particles} and "
                f"steps={steps} must be 1 or more"
            )
        if not 1 <= max_searches <= 4:
            raise UserError(f"filter.max_searches={max_searches}: must be 1, 2, 3 or 4")
        if magnified_width is not None and not 0 < magnified_width <= 1:
            raise UserError(f"filter.magnified_width={magnified_width}: must be above 0, 1 at most")
        self.particles, self.steps, self.max_searches = particles, steps, max_searches
        self.magnified_width = magnified_width
        self.initial_particles = first
        self.initialize, self.schedule = initialize, schedule
        self.reweight, self.resample, self.propagate = reweight, resample, propagate
        self.estimate, self.refine = estimate, refine

    @property
    def score_is(self) -> str:
        """What the belief's score is, in words: as the refinement says, or else the estimate."""
        for component in (self.refine, self.estimate):
            if description := getattr(component, "score_is", ""):
                return str(description)
        return f"as {type(self.estimate).__name__} defines it"

    def forward(self, batch: Batch, method: Method, generator: Generator) -> Trace:
        """Run the filter on B images at once, each independent of the others.

        Args:
            batch: The images.
            method: Encodes images and measures particles.
            generator: Source of all randomness.

        Returns:
            Particles and outputs of every step, the log evidence (B, T), and the belief.

        Raises:
            FloatingPointError: All weights of an image are zero, or not numbers.
        """
        encoding = method.encode(batch)
        iterations = self.iterate(batch, encoding, method, generator)
        return self.finish(list(iterations), encoding, method, generator)

    def iterate(
        self, batch: Batch, encoding: Encoding, method: Method, generator: Generator
    ) -> Iterator[Iteration]:
        """Run the filter step by step; arguments as of `forward`, with the images encoded.

        Yields:
            What each step leaves; the first measures the initial particles.
        """
        state = self.initialize(batch, encoding, method, self.initial_particles, generator)
        particles = make_particles(state, method.latent_width)
        ancestor_log_likelihood = torch.zeros_like(particles.log_weights)
        resample = bind_to_encoding(self.resample, encoding, batch)
        output: ParticleOutput | None = None
        # one tensor: a GPU is waited for when it is sent one
        for number, sigma in enumerate(state.new_tensor([*self.schedule(self.steps)])):
            step = Step(number, self.steps, sigma)
            if output is not None:
                *parts, ancestor_log_likelihood = self._advance(
                    particles, output, step, resample, method.space, generator
                )
                particles = Particles(*parts)
            output = method.measure(encoding, particles, step, generator)
            log_weights = self.reweight(
                particles.log_weights, output.log_likelihood, ancestor_log_likelihood
            )
            increment = log_weights.logsumexp(1)
            particles = particles._replace(log_weights=log_weights - increment[:, None])
            yield Iteration(particles, output, step, increment)

    def _advance(
        self,
        particles: Particles,
        output: ParticleOutput,
        step: Step,
        resample: Resample,
        space: Space,
        generator: Generator,
    ) -> tuple[Tensor, ...]:
        """Resample and move particles.  -> the parts of `Particles`, and the log-likelihoods (B, N)
        of their ancestors.

        A GPU replays it, where its components can be recorded.
        """

        def work(*parts: Tensor, generator: Generator) -> tuple[Tensor, ...]:
            state, log_weights, displacement, latent, log_likelihood, sigma = parts
            own = particles._replace(state=state, log_weights=log_weights)  # all that these read
            resampled = resample(own, self.particles, space, generator)
            moved = self.propagate(
                inherit(state, resampled, space),
                inherit(displacement, resampled),
                step._replace(sigma=sigma),
                space,
                generator,
            )
            latent = inherit(latent, resampled)
            if resampled.mixture_weights is not None:
                # a particle of likelihood 0 has no weight, so no part in a mixture; 0 * inf is NaN
                log_likelihood = log_likelihood.masked_fill(log_likelihood.isneginf(), 0.0)
            before = inherit(log_likelihood[..., None], resampled)[..., 0]
            return moved, latent, resampled.log_weights, resampled.ancestors, before

        parts = [particles.state, particles.log_weights, output.displacement, output.latent]
        parts += [output.log_likelihood, step.sigma]
        components = (resample, self.propagate)
        if not (cuda_graphs.applies(*parts) and all(map(can_be_recorded, components))):
            return work(*parts, generator=generator)
        key = (self.particles, space, components, cuda_graphs.describe(*parts))
        found: tuple[Tensor, ...] = _find_recording(key)(work, *parts, generator=generator)
        return found

    def finish(
        self,
        iterations: Sequence[Iteration],
        encoding: Encoding,
        method: Method,
        generator: Generator,
    ) -> Trace:
        """Return the trace of all iterations, with the belief of the last one's particles.

        Raises:
            FloatingPointError: All weights of an image are zero, or not numbers.
        """
        particles, outputs, steps, evidence = zip(*iterations, strict=True)
        log_evidence = torch.stack(evidence, dim=1)
        check_finite(log_evidence)
        belief = self.estimate(particles[-1], outputs[-1], encoding, method, generator)
        belief = self.refine(belief, encoding, method, generator)
        return Trace(particles, outputs, steps, belief, log_evidence, encoding)


def can_be_recorded(component: object) -> bool:
    """Return whether a GPU can replay what a component does, with all that it is made of."""
    return all(
        "recordable" in read_declared(type(part)).provides
        for part in list_parts(component)
        if callable(part)
    )


def make_particles(state: Tensor, latent_width: int) -> Particles:
    """Return particles of equal weight with a latent of zeros.  (B, N, *S) -> Particles."""
    B, N = state.shape[:2]
    latent = state.new_zeros(B, N, latent_width)
    log_weights = state.new_full((B, N), -math.log(N))
    return Particles(state, latent, log_weights, torch.arange(N, device=state.device).expand(B, N))


def inherit(values: Tensor, resampled: Resampled, space: Space | None = None) -> Tensor:
    """Return the values of each child's ancestor.  (B, M, *V) -> (B, N, *V).

    Where children are mixtures of particles (`resampled.mixture_weights`), their values are
    weighted means: those of `space` for states, arithmetic ones if it is None.
    """
    if resampled.mixture_weights is None:
        return _take(values, resampled.ancestors)
    if space is not None:
        return space.mean(values[:, None], resampled.mixture_weights)
    return resampled.mixture_weights @ values


def _take(values: Tensor, ancestors: Tensor) -> Tensor:
    """Return the rows of ancestors.  (B, M, *V), (B, N) -> (B, N, *V)."""
    B, N = ancestors.shape
    if values.stride(1) == 0:  # all particles have the same
        return values[:, :1].expand(B, N, *values.shape[2:])
    if values.requires_grad or values.device.type != "cpu" or not values.is_contiguous():
        index = ancestors[(...,) + (None,) * (values.dim() - 2)]
        return values.gather(1, index.expand(B, N, *values.shape[2:]))
    # whole rows are copied several times faster than their entries one by one
    rows = ancestors
    if B > 1:
        rows = ancestors + values.shape[1] * torch.arange(B)[:, None]
    return values.flatten(0, 1).index_select(0, rows.flatten()).view(B, N, *values.shape[2:])


def check_finite(log_evidence: Tensor) -> None:
    """Raise FloatingPointError where the log evidence (B, T) is not finite."""
    failed = ~log_evidence.isfinite()
    if bool(failed.any()):
        image, step = failed.nonzero()[0].tolist()
        raise FloatingPointError(
            f"the particle filter failed at step {step} (image {image} of the batch): the log "
            f"weights sum to {log_evidence[image, step].item()}, so the likelihood is not finite "
            f"or zero everywhere"
        )
