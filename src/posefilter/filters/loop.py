"""The particle filter that every method shares.  Read this page, then contracts.py: the rest of the project is pieces.

scene = method.observe(batch)                              once an image
cloud = initialise(...)                                    a first guess, all weights equal
repeat:  reading = method.read(scene, cloud, step)         what does each particle see?
         cloud   = reweigh(...)                            believe those that see the object
         children = resample(...), cloud = propose(...)    more of those, moved a little
belief = refine(estimate(...))                             the last word
"""

import math

import torch
from torch import Generator, Tensor, nn

from posefilter.contracts import Estimate, Initialise, Method, Propose, Refine, Resample, Reweigh, Schedule, Space
from posefilter.errors import UserError
from posefilter.filters.guided import bound
from posefilter.types import Batch, Children, Cloud, Reading, Step, Trace


class ParticleFilter(nn.Module):
    """Weighted particles, read, reweighed, resampled and moved for a number of steps.

    Keeps no tensor between calls, and draws all that is random from the generator it is given. Differentiable from the
    belief back to the likelihood and the motion, as far as the chosen pieces allow it.

    particles: in every cloud, but for the first where `first_particles` says otherwise: a wide search is only needed once.
    steps: how many clouds are read.
    """

    def __init__(
        self,
        particles: int,
        steps: int,
        initialise: Initialise,
        schedule: Schedule,
        reweigh: Reweigh,
        resample: Resample,
        propose: Propose,
        estimate: Estimate,
        refine: Refine,
        first_particles: int | None = None,
    ) -> None:
        super().__init__()
        if min(particles, steps, first_particles or 1) < 1:
            raise UserError(
                f"filter: particles={particles}, first_particles={first_particles} and steps={steps} must be 1 or more"
            )
        self.particles, self.steps = particles, steps
        self.first_particles = first_particles or particles
        self.initialise, self.schedule = initialise, schedule
        self.reweigh, self.resample, self.propose = reweigh, resample, propose
        self.estimate, self.refine = estimate, refine

    def forward(self, batch: Batch, method: Method, generator: Generator) -> Trace:
        """Run the filter over B images at once; none of them sees another."""
        scene = method.observe(batch)
        state = self.initialise(batch, scene, method, self.first_particles, generator)
        cloud = first_cloud(state, method.memory_width)
        inherited = torch.zeros_like(cloud.log_weights)
        timetable = self.timetable(state)
        resample = bound(self.resample, scene, batch)
        clouds: list[Cloud] = []
        readings: list[Reading] = []
        evidence: list[Tensor] = []
        for step in timetable:
            if readings:
                children = resample(cloud, self.particles, method.space, generator)
                state = inherit(cloud.state, children, method.space)
                motion = inherit(readings[-1].motion, children)
                state = self.propose(state, motion, step, method.space, generator)
                memory = inherit(readings[-1].memory, children)
                inherited = inherit(readings[-1].log_likelihood[..., None], children)[..., 0]
                cloud = Cloud(state, memory, children.log_weights, children.parents)
            reading = method.read(scene, cloud, step, generator)
            log_weights = self.reweigh(cloud.log_weights, reading.log_likelihood, inherited)
            total = log_weights.logsumexp(1)
            cloud = cloud._replace(log_weights=log_weights - total[:, None])
            clouds.append(cloud)
            readings.append(reading)
            evidence.append(total)
        log_evidence = torch.stack(evidence, dim=1)
        check_alive(log_evidence)
        belief = self.estimate(clouds[-1], readings[-1], scene, method, generator)
        belief = self.refine(belief, scene, method, generator)
        return Trace(tuple(clouds), tuple(readings), timetable, belief, log_evidence)

    def timetable(self, like: Tensor) -> tuple[Step, ...]:
        """Return what each step is told of where it stands; `like` gives device and precision."""
        levels = self.schedule(self.steps)
        return tuple(Step(number, self.steps, like.new_tensor(sigma)) for number, sigma in enumerate(levels))


def first_cloud(state: Tensor, memory_width: int) -> Cloud:
    """Give each particle an equal weight and an empty memory.  (B, N, *S) -> Cloud."""
    B, N = state.shape[:2]
    memory = state.new_zeros(B, N, memory_width)
    log_weights = state.new_full((B, N), -math.log(N))
    return Cloud(state, memory, log_weights, torch.arange(N, device=state.device).expand(B, N))


def inherit(values: Tensor, children: Children, space: Space | None = None) -> Tensor:
    """Hand parents' values down to their children.  (B, M, *V) -> (B, N, *V).

    Where children are mixes, values are averaged by their shares: as `space` averages states, or plainly if it is None.
    """
    if children.shares is None:
        index = children.parents[(...,) + (None,) * (values.dim() - 2)]
        return values.gather(1, index.expand(*children.parents.shape, *values.shape[2:]))
    if space is not None:
        return space.mean(values[:, None], children.shares)
    return children.shares @ values


def check_alive(log_evidence: Tensor) -> None:
    """Raise FloatingPointError if at some step an image's weights were all zero, or not numbers.  (B, T)."""
    dead = ~log_evidence.isfinite()
    if bool(dead.any()):
        image, step = dead.nonzero()[0].tolist()
        raise FloatingPointError(
            f"the particle filter died at step {step} (image {image} of the batch): the log weights sum to "
            f"{log_evidence[image, step].item()}, so the likelihood is not finite or zero everywhere"
        )
