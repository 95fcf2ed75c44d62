"""Candidates that the pose-space method's likelihood is trained on, as a trace of one step."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol, runtime_checkable

import torch
from torch import Generator, Tensor

from posefilter.capabilities import Capabilities
from posefilter.errors import check_range
from posefilter.filters.candidates import PersistentParticles, sample_around_truth
from posefilter.filters.estimate import select_particle
from posefilter.filters.initialize import draw_from_depth
from posefilter.filters.loop import make_particles
from posefilter.filters.propagate import HalfTurnRotations
from posefilter.geometry.camera import back_project, rays
from posefilter.geometry.pose import invert, transform
from posefilter.protocols import Encoding, Propagate
from posefilter.types import Batch, ParticleOutput, Particles, Step, Trace

if TYPE_CHECKING:
    from posefilter.models.pose_pf import PosePF


@runtime_checkable
class ScoresSamples(Protocol):
    """A likelihood that scores colored points by themselves; required by labeled rays."""

    def score_samples(self, position: Tensor, color: Tensor) -> Tensor:
        """Score points (*, 3) in the object frame [m] with colors (*, 3) in [0, 1].  -> (*)."""


class CandidateSampler:
    """Draw and score the candidates of one batch; it keeps nothing from batch to batch."""

    def __call__(
        self, method: "PosePF", encoding: Encoding, batch: Batch, generator: Generator
    ) -> Trace:
        """Return a trace of one step whose scores are differentiable.

        Args:
            method: Scores the candidates.
            encoding: Its encoded images.
            batch: B images with their truth.
            generator: Source of randomness.
        """
        raise NotImplementedError

    def state(self) -> dict[str, Tensor]:
        """Return what is kept from batch to batch, for checkpoints."""
        return {}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""


def one_step_trace(particles: Particles, output: ParticleOutput, sigma: Tensor) -> Trace:
    """Wrap scored poses as a trace whose belief is the softmax of the scores.

    Args:
        particles: B x N particles.
        output: Their scores and poses.
        sigma: (B,) noise level [m].
    """
    scored = particles._replace(log_weights=output.log_likelihood.log_softmax(1))
    belief = select_particle(scored, output, output.log_likelihood)
    return Trace((particles,), (output,), (Step(0, 1, sigma),), belief)


class CandidatePoses(CandidateSampler):
    """Draw candidates of several kinds, all of an image at one noise level.

    Args:
        candidates_per_kind: Candidates of each kind around the truth.
        proposals: Poses from the proposal network, where there is one.
        particles: Persistent particles of the filter's own, which are hard negatives; 0 for none.
        sigma_range: Lowest and highest noise level [m].
        initial_sigma: Noise level at which persistent particles start from proposals, as they do
            at test time [m]. Without proposals they start from depth, at the highest level.
        sigma_levels: Steps of the persistent particles from there to the lowest level.
        persistent_sigma_probability: Probability that an image is scored at the noise level of its
            persistent particles, rather than at one drawn from `sigma_range`.
        rotations: Kernel that turns the truth, for hard negatives. By default half turns about the
            axes of the mesh's frame.
    """

    provides: ClassVar[Capabilities] = ("candidates",)

    def __init__(
        self,
        candidates_per_kind: int = 8,
        proposals: int = 8,
        particles: int = 16,
        sigma_range: tuple[float, float] = (0.004, 0.25),
        initial_sigma: float = 0.05,
        sigma_levels: int = 12,
        persistent_sigma_probability: float = 0.5,
        rotations: Propagate | None = None,
    ) -> None:
        self.candidates_per_kind, self.proposals = candidates_per_kind, proposals
        self.sigma_range = check_range("model.candidate_sampler.sigma_range", sigma_range, 0.0)
        self.persistent_sigma_probability = persistent_sigma_probability
        self.initial_sigma = float(initial_sigma)
        self.rotations = rotations or HalfTurnRotations(1.0)
        self.persistent = (
            PersistentParticles(particles, sigma_levels, self.sigma_range[0]) if particles else None
        )

    def __call__(
        self, method: "PosePF", encoding: Encoding, batch: Batch, generator: Generator
    ) -> Trace:
        """Draw and score candidates, and advance the persistent particles by a step."""
        B, device = len(batch.rgb), batch.rgb.device
        object_model = method.object_model
        low, high = math.log(self.sigma_range[0]), math.log(self.sigma_range[1])
        sigma = torch.exp(torch.empty(B, device=device).uniform_(low, high, generator=generator))
        space, per_kind = method.space, self.candidates_per_kind
        groups = [
            sample_around_truth(
                batch, object_model, space, per_kind, self.sigma_range, generator, self.rotations
            )
        ]
        proposes = "propose_poses" in method.capabilities
        if self.proposals and proposes:
            groups.append(method.propose_poses(encoding, self.proposals, generator))
        at_persistent_sigma = torch.zeros(B, dtype=torch.bool, device=device)
        if self.persistent is not None:
            count = self.persistent.particles
            if proposes:
                fresh, start = method.propose_poses(encoding, count, generator), self.initial_sigma
            else:
                fresh = draw_from_depth(batch.depth, batch.intrinsics, space, count, generator)
                start = self.sigma_range[1]
            states, level = self.persistent.recall(batch, fresh, start)
            chance = torch.rand(B, device=device, generator=generator)
            at_persistent_sigma = chance < self.persistent_sigma_probability
            sigma = torch.where(at_persistent_sigma, level, sigma)
            groups.append(states)
        particles = make_particles(torch.cat(groups, dim=1), 0)
        output = method.measure(encoding, particles, Step(0, 1, sigma), generator)
        if self.persistent is not None:
            scores = output.log_likelihood[:, -self.persistent.particles :].detach()
            self.persistent.advance(
                batch, states, scores, sigma, at_persistent_sigma, space, generator
            )
        return one_step_trace(particles, output, sigma)

    def state(self) -> dict[str, Tensor]:
        """Return the state of the persistent particles."""
        return self.persistent.state() if self.persistent is not None else {}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restore the persistent particles."""
        if self.persistent is not None:
            self.persistent.restore(state)


def pick_pixels(usable: Tensor, count: int | None, generator: Generator) -> tuple[Tensor, Tensor]:
    """Draw pixels of each image with replacement, or list all of them.

    Args:
        usable: (B, H * W) 1 for pixels to choose from, else 0.
        count: Pixels of an image; None for all of them, padded to the longest list.
        generator: Source of randomness; not used where all are listed.

    Returns:
        Indices (B, R), and which of them are usable (B, R) bool: padding is not, nor any pixel of
        an image that has none.
    """
    if count is not None:
        empty = usable.sum(1, keepdim=True) == 0
        pick = torch.multinomial(usable + empty, count, replacement=True, generator=generator)
        return pick, (~empty).expand_as(pick)
    longest = max(1, int(usable.sum(1).max()))
    drawn, pick = usable.sort(dim=1, descending=True, stable=True)
    return pick[:, :longest], drawn[:, :longest] > 0


@dataclass(eq=False)
class LabeledRays(CandidateSampler):
    """The paper's samples: points along the rays of the object's pixels, scored singly (section 5).

    Args:
        rays: Mask pixels of an image, drawn with replacement; None: all of them once, as in the
            paper.
        samples: Points on a ray, evenly spaced.
        min_depth: Depth of the first [m].
        margin_behind: How far the last lies behind the observed point [m].
        tolerance: Half width of the surface [m]; on it a second sample has the observed color.
            Other colors are random.
    """

    provides: ClassVar[Capabilities] = ("ray_samples",)
    requires: ClassVar[Capabilities] = ("score_samples",)

    rays: int | None = 64
    samples: int = 30
    min_depth: float = 0.10
    margin_behind: float = 0.05
    tolerance: float = 0.01

    def __call__(
        self, method: "PosePF", encoding: Encoding, batch: Batch, generator: Generator
    ) -> Trace:
        """Draw and score samples.

        Returns:
            A trace whose states are (B, N, 4): u, v [px], offset behind the surface [m], and 1
            where the color is the observed one.
        """
        net = method.likelihood
        assert isinstance(net, ScoresSamples)  # of what `requires` says
        B, _, _, W = batch.depth.shape
        device = batch.rgb.device
        depth = batch.depth.flatten(1)
        usable = (batch.mask.flatten(1) & (depth > self.min_depth)).float()
        pick, drawn = pick_pixels(usable, self.rays, generator)
        pixel = torch.stack([pick % W, pick // W], dim=-1).float()
        z = depth.gather(1, pick)[..., None]
        fraction = torch.linspace(0, 1, self.samples, device=device)
        # (B, rays, samples) z-depth [m]
        at = self.min_depth + (z + self.margin_behind - self.min_depth) * fraction
        length = rays(pixel, batch.intrinsics).norm(dim=-1, keepdim=True)
        offset = ((at - z) * length).flatten(1)
        pixel = pixel[:, :, None].expand(-1, -1, self.samples, -1).flatten(1, 2)
        point = transform(
            invert(batch.camera_from_object), back_project(pixel, at.flatten(1), batch.intrinsics)
        )
        observed = encoding.image.values.gather(1, pick[..., None].expand(-1, -1, 3))
        observed = observed[:, :, None].expand(-1, -1, self.samples, -1).flatten(1, 2)
        random = torch.rand(observed.shape, generator=generator, device=device)
        valid = drawn[:, :, None].expand(-1, -1, self.samples).flatten(1)
        near = (offset.abs() <= self.tolerance) & valid
        state = [
            torch.cat(
                [pixel, offset[..., None], torch.full_like(offset, is_observed)[..., None]], -1
            )
            for is_observed in (0.0, 1.0)
        ]
        weight = torch.cat([valid, near], dim=1).float()
        scores = net.score_samples(torch.cat([point, point], 1), torch.cat([random, observed], 1))
        log_weights = (weight / weight.sum(1, keepdim=True).clamp_min(1)).log()
        particles = make_particles(torch.cat(state, dim=1), 0)._replace(log_weights=log_weights)
        pose = batch.camera_from_object[:, None].expand(-1, scores.shape[1], -1, -1)
        no_move = scores.new_zeros(B, scores.shape[1], 6)
        output = ParticleOutput(scores, no_move, pose, particles.latent)
        return one_step_trace(particles, output, torch.full((B,), self.tolerance, device=device))
