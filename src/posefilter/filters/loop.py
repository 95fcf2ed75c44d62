"""The particle filter that every method shares.  Read this page, then protocols.py: the rest of the
project is pieces.

scene = method.encode(batch)                              once an image
cloud = initialize(...)                                    a first guess, all weights equal
repeat:  reading = method.measure(scene, cloud, step)         what does each particle see?
         cloud   = reweight(...)                            believe those that see the object
         children = resample(...), cloud = propagate(...)    more of those, moved a little
belief = refine(estimate(...))                             the last word
"""

import math

import torch
from torch import Generator, Tensor, nn

from posefilter.errors import UserError
from posefilter.filters.guided import bound
from posefilter.protocols import (
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


class ParticleFilter(nn.Module):
    """Weighted particles, read, reweighed, resampled and moved for a number of steps.

    Keeps no tensor between calls, and draws all that is random from the generator it is given.
    Differentiable from the belief back to the likelihood and the displacement, as far as the chosen
    pieces allow it.

    particles: in every cloud, but for the first where `first_particles` says otherwise: a wide
    search is only needed once. steps: how many clouds are read.
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
        first_particles: int | None = None,
    ) -> None:
        super().__init__()
        if min(particles, steps, first_particles or 1) < 1:
            raise UserError(
                f"filter: particles={particles}, first_particles={first_particles} and "
                f"steps={steps} must be 1 or more"
            )
        self.particles, self.steps = particles, steps
        self.first_particles = first_particles or particles
        self.initialize, self.schedule = initialize, schedule
        self.reweight, self.resample, self.propagate = reweight, resample, propagate
        self.estimate, self.refine = estimate, refine

    def forward(self, batch: Batch, method: Method, generator: Generator) -> Trace:
        """Run the filter over B images at once; none of them sees another."""
        scene = method.encode(batch)
        state = self.initialize(batch, scene, method, self.first_particles, generator)
        particles = make_particles(state, method.latent_width)
        inherited = torch.zeros_like(particles.log_weights)
        timetable = self.timetable(state)
        resample = bound(self.resample, scene, batch)
        history: list[Particles] = []
        outputs: list[ParticleOutput] = []
        evidence: list[Tensor] = []
        for step in timetable:
            if outputs:
                resampled = resample(particles, self.particles, method.space, generator)
                state = inherit(particles.state, resampled, method.space)
                displacement = inherit(outputs[-1].displacement, resampled)
                state = self.propagate(state, displacement, step, method.space, generator)
                latent = inherit(outputs[-1].latent, resampled)
                inherited = inherit(outputs[-1].log_likelihood[..., None], resampled)[..., 0]
                particles = Particles(state, latent, resampled.log_weights, resampled.ancestors)
            output = method.measure(scene, particles, step, generator)
            log_weights = self.reweight(particles.log_weights, output.log_likelihood, inherited)
            total = log_weights.logsumexp(1)
            particles = particles._replace(log_weights=log_weights - total[:, None])
            history.append(particles)
            outputs.append(output)
            evidence.append(total)
        log_evidence = torch.stack(evidence, dim=1)
        check_alive(log_evidence)
        belief = self.estimate(history[-1], outputs[-1], scene, method, generator)
        belief = self.refine(belief, scene, method, generator)
        return Trace(tuple(history), tuple(outputs), timetable, belief, log_evidence)

    def timetable(self, like: Tensor) -> tuple[Step, ...]:
        """Return what each step is told of where it stands; `like` gives device and precision."""
        levels = self.schedule(self.steps)
        return tuple(
            Step(number, self.steps, like.new_tensor(sigma)) for number, sigma in enumerate(levels)
        )


def make_particles(state: Tensor, latent_width: int) -> Particles:
    """Give each particle an equal weight and an empty latent.  (B, N, *S) -> Particles."""
    B, N = state.shape[:2]
    latent = state.new_zeros(B, N, latent_width)
    log_weights = state.new_full((B, N), -math.log(N))
    return Particles(state, latent, log_weights, torch.arange(N, device=state.device).expand(B, N))


def inherit(values: Tensor, resampled: Resampled, space: Space | None = None) -> Tensor:
    """Hand parents' values down to their children.  (B, M, *V) -> (B, N, *V).

    Where children are mixes, values are averaged by their shares: as `space` averages states, or
    plainly if it is None.
    """
    if resampled.shares is None:
        index = resampled.ancestors[(...,) + (None,) * (values.dim() - 2)]
        return values.gather(1, index.expand(*resampled.ancestors.shape, *values.shape[2:]))
    if space is not None:
        return space.mean(values[:, None], resampled.shares)
    return resampled.shares @ values


def check_alive(log_evidence: Tensor) -> None:
    """Raise FloatingPointError if at some step an image's weights were all zero, or not numbers.

    (B, T).
    """
    dead = ~log_evidence.isfinite()
    if bool(dead.any()):
        image, step = dead.nonzero()[0].tolist()
        raise FloatingPointError(
            f"the particle filter died at step {step} (image {image} of the batch): the log "
            f"weights sum to "
            f"{log_evidence[image, step].item()}, so the likelihood is not finite or zero "
            f"everywhere"
        )
