"""Markov moves of the last particles between and within modes: resample-move.

Importance sampling gives each mode its mass, but leaves few different particles where weights are
uneven, and none at a mode that the search has lost.  Moves that leave the posterior unchanged mend
both (Gilks and Berzuini 2001; the rejuvenation of Del Moral, Doucet and Jasra 2006).

References:
    Gilks, Berzuini: Following a moving target - Monte Carlo inference for dynamic Bayesian models.
        Journal of the Royal Statistical Society B 63 (2001).
    ter Braak: A Markov chain Monte Carlo version of the genetic algorithm differential evolution.
        Statistics and Computing 16 (2006).
    Goodman, Weare: Ensemble samplers with affine invariance. Communications in Applied Mathematics
        and Computational Science 5 (2010).
"""

import math
from collections.abc import Callable
from typing import ClassVar

import torch
from torch import Generator, Tensor

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.filters.propagate import AxisRotations
from posefilter.filters.refine import scorer_of
from posefilter.filters.resample import Systematic, inverse_cdf
from posefilter.geometry.pose import take_poses
from posefilter.geometry.pose_statistics import twist_between
from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Encoding, Method
from posefilter.types import BeliefBatch

_NEAREST = 0.005  # least share of the pairs that a difference is drawn from
_MOST_PARTNERS = 300  # particles of the other half whose differences are used


class ResampleMove:
    """Resample the particles, and move each by Metropolis-Hastings steps.

    The target is the posterior exp(l / T) with a flat prior, T temperature, l the log-likelihood.
    A sweep proposes one step of each particle, either

    - the difference of two other particles: the shift between them, and the turn between them in
      the object's own axes (differential evolution, ter Braak 2006).  Of a near pair it is a step
      within a mode, as long and as slanted as the modes are.  Of a far pair it is the step from one
      mode to another: of a symmetric object, a symmetry that the particles have found themselves;
    - or a turn about an axis of the object's smallest box, by pi or by any angle, which reaches
      modes that no particle is at.

    Both proposals are as likely as their inverse, so that min(1, ratio of the posteriors) accepts
    (Metropolis et al. 1953).  Differences are of the half of the particles that stays, so that each
    half-sweep leaves the joint posterior of all particles unchanged (Goodman and Weare 2010).  The
    likelihood reads the same image points throughout.  The estimate and its score are kept.

    Args:
        sweeps: Steps of each particle.
        rotation_probability: Probability that a step is a rotation about an axis.
        uniform_angle_probability: Probability that a turn's angle is uniform rather than pi.
        temperature: T; 1 takes the likelihood at its word, more makes the belief wider.
        sigma: Noise level of the likelihood [m].
        pixels: Image points that each particle is scored from.

    Raises:
        UserError: A number is out of range.
    """

    requires: ClassVar[Capabilities] = ("common_points", "pose_space", "score_poses")

    def __init__(
        self,
        sweeps: int = 12,
        rotation_probability: float = 0.2,
        uniform_angle_probability: float = 0.7,
        temperature: float = 1.0,
        sigma: float = 0.004,
        pixels: int = 256,
    ) -> None:
        shares = (rotation_probability, uniform_angle_probability)
        if sweeps < 0 or not all(0 <= share <= 1 for share in shares) or not temperature > 0:
            raise UserError(
                f"refine: resample-move needs sweeps >= 0, probabilities between 0 and 1 and "
                f"temperature > 0, got {sweeps}, {shares} and {temperature}"
            )
        self.sweeps, self.rotation_probability = sweeps, rotation_probability
        self.rotations = AxisRotations(1.0, uniform_angle_probability)
        self.temperature, self.sigma, self.pixels = temperature, sigma, pixels

    @torch.no_grad()
    def __call__(
        self, belief: BeliefBatch, encoding: Encoding, method: Method, generator: Generator
    ) -> BeliefBatch:
        """Return the belief with particles of equal weight; without gradient."""
        space, device = method.space, belief.poses.device
        assert isinstance(space, PoseSpace)  # of what `requires` says
        B, N = belief.log_weights.shape
        seed = int(torch.randint(1 << 62, (), generator=generator, device=device))

        def score(poses: Tensor) -> Tensor:
            # the same image points each time: the target stays as it is
            fixed = torch.Generator(device).manual_seed(seed)
            log_likelihood = scorer_of(method).score_poses(
                encoding, poses.to(belief.poses), self.sigma, fixed, self.pixels
            )
            return log_likelihood.double() / self.temperature

        strata = Systematic().uniforms(B, N, generator, device)
        poses = take_poses(belief.poses.double(), inverse_cdf(belief.log_weights, strata))
        log_target = score(poses)
        for _ in range(self.sweeps):
            poses, log_target = self.sweep(poses, log_target, score, space, generator)
        even = torch.full_like(belief.log_weights, -math.log(N))
        return belief._replace(poses=poses.to(belief.poses), log_weights=even)

    def sweep(
        self,
        poses: Tensor,
        log_target: Tensor,
        score: Callable[[Tensor], Tensor],
        space: PoseSpace,
        generator: Generator,
    ) -> tuple[Tensor, Tensor]:
        """Propose one step of each particle, first of one half, then of the other.

        (B, N, 4, 4), (B, N) the target's log density at them, which `score` computes -> the same
        after the sweep, shuffled.
        """
        order = torch.rand(log_target.shape, generator=generator, device=poses.device).argsort(1)
        poses, log_target = take_poses(poses, order), log_target.gather(1, order)
        half = poses.shape[1] // 2
        for moving, fixed in ((slice(half), slice(half, None)), (slice(half, None), slice(half))):
            if not log_target[:, moving].numel():  # the first half of one particle
                continue
            proposed = self.propose(poses[:, moving], poses[:, fixed], space, generator)
            new, old = score(proposed), log_target[:, moving]
            chance = torch.rand(old.shape, generator=generator, device=old.device, dtype=old.dtype)
            accept = chance.log() < new - old
            poses[:, moving] = torch.where(accept[..., None, None], proposed, poses[:, moving])
            log_target[:, moving] = torch.where(accept, new, old)
        return poses, log_target

    def propose(
        self, poses: Tensor, others: Tensor, space: PoseSpace, generator: Generator
    ) -> Tensor:
        """Return a proposal for each pose.  (B, N, 4, 4), (B, M, 4, 4) -> (B, N, 4, 4)."""
        turned = self.rotations(poses, poses, None, space, generator)  # type: ignore[arg-type]
        step = draw_differences(others, poses.shape[1], space, generator)
        chance = torch.rand(poses.shape[:2], generator=generator, device=poses.device)
        rotated = chance < self.rotation_probability
        return torch.where(rotated[..., None, None], turned, space.move(poses, step))


def draw_differences(poses: Tensor, count: int, space: PoseSpace, generator: Generator) -> Tensor:
    """Draw twists between pairs of poses; near pairs are preferred, and either order is as likely.

    For each a share s is drawn, its logarithm uniform, then one of the share s of the pairs that
    are nearest to each other.

    (B, M, 4, 4) -> (B, count, 6); zeros where there are fewer than two poses.  The distance of
    `space` tells what is near.
    """
    poses = poses[:, :_MOST_PARTNERS]
    B, M = poses.shape[:2]
    if M < 2:
        return poses.new_zeros(B, count, 6)
    first, second = torch.triu_indices(M, M, 1, device=poses.device)
    distance = space.distance(poses[:, :, None], poses[:, None])[:, first, second]
    nearest = distance.argsort(1)
    chance = torch.rand(3, B, count, generator=generator, device=poses.device)
    rank = (len(first) * chance[1] * _NEAREST ** chance[0]).long()
    pair = nearest.gather(1, rank)
    swap = chance[2] < 0.5
    start = torch.where(swap, second[pair], first[pair])
    end = torch.where(swap, first[pair], second[pair])
    start, end = take_poses(poses, start), take_poses(poses, end)
    return twist_between(start, end, poses.new_tensor(space.center))
