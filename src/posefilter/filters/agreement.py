"""The pose that explains most particles' own surface points, by hypothesis and verification."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Generator, Tensor

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.geometry.pose import fit_rigid, invert, take_poses, transform
from posefilter.geometry.votes import draw_votes
from posefilter.protocols import Encoding, HasSurfacePoints, Method
from posefilter.types import BeliefBatch, ParticleOutput, Particles


@dataclass(eq=False)
class Agreement:
    """Estimate the pose that most particles' surface points agree on, weighted by likelihood.

    Each particle predicts which object point its own measured point is: by its pose, or by its
    `top_fragments` most probable fragments where the method predicts fragments. The hypotheses are
    the poses of the particles of highest likelihood, and as many rigid fits to a few particles'
    points (RANSAC, Fischler and Bolles 1981). A hypothesis is scored by the weight of its inliers,
    at the scale 2 `scale_m`. The best one is refitted to all particles by iteratively reweighted
    least squares: Kabsch's fit (1976) with Geman-McClure weights, whose scale falls from 4
    `scale_m` to `scale_m`.

    The belief is the set of fitted poses, each weighted by its share of inliers to the power of
    `effective_particles`.

    Args:
        scale_m: Scale of the residuals of inliers [m].
        hypotheses: Number of hypotheses of each kind.
        iterations: Iterations of the refit.
        top_fragments: Fragments considered for each particle.
        effective_particles: How many particles count as independent observations.
    """

    requires: ClassVar[Capabilities] = ("pose", "surface_points")
    score_is: ClassVar[str] = (
        "share of the particles' likelihood whose surface points agree with the estimate, times "
        "the highest likelihood of a particle; no probability"
    )

    scale_m: float = 0.015
    hypotheses: int = 64
    iterations: int = 8
    top_fragments: int = 3
    effective_particles: float = 8.0

    def __post_init__(self) -> None:
        if min(self.hypotheses, self.top_fragments) < 1 or self.scale_m <= 0:
            raise UserError(
                f"estimate: hypotheses={self.hypotheses} and top_fragments={self.top_fragments} "
                f"must be 1 or more, and scale_m={self.scale_m} above 0"
            )

    def __call__(
        self,
        particles: Particles,
        output: ParticleOutput,
        encoding: Encoding,
        method: Method,
        generator: Generator,
    ) -> BeliefBatch:
        """Return the belief at the agreed pose.

        Its score is the share of the weight that agrees, times the highest likelihood.
        """
        assert isinstance(method, HasSurfacePoints)  # of what `requires` says
        object_model = method.object_model
        center, radius = object_model.center.to(particles.state), object_model.radius
        point, measured = method.surface_points(encoding, particles.state)
        share, position = self.list_object_points(output, point, center, radius)
        log_likelihood = output.log_likelihood.detach()
        # known up to a constant of the image
        weight = (log_likelihood - log_likelihood.amax(1, keepdim=True)).exp() * measured
        votes = draw_votes(
            point, weight, share, position, center, radius, self.hypotheses, generator
        )
        weight = weight + 1e-9  # where none is measured, all count
        top = weight.topk(min(self.hypotheses, weight.shape[1]), dim=1).indices
        hypotheses = torch.cat([votes, take_poses(output.pose.detach(), top)], dim=1)
        object_point = center + radius * position
        fit = self._inliers(hypotheses, object_point[:, None], point[:, None], 2 * self.scale_m)
        support = (weight[:, None] * (share[:, None] * fit).sum(-1)).sum(-1)
        best = hypotheses[torch.arange(len(support), device=support.device), support.argmax(1)]
        for i in range(self.iterations):
            scale = self.scale_m * 2 ** (2 - 2 * i / max(self.iterations - 1, 1))
            fit, option = (share * self._inliers(best, object_point, point, scale)).max(-1)
            chosen = object_point.gather(2, option[..., None, None].expand(-1, -1, 1, 3))[:, :, 0]
            best = fit_rigid(chosen, point, weight * fit)
        # a weight of 0.04 is a residual of two scales
        agreeing = (share * (self._inliers(best, object_point, point, self.scale_m) > 0.04)).sum(-1)
        agreed = (weight * agreeing).sum(1) / weight.sum(1)
        score = agreed * output.log_likelihood.exp().max(1).values
        log_support = support[:, : self.hypotheses].clamp_min(1e-30).log()
        log_weights = (self.effective_particles * log_support).log_softmax(1)
        return BeliefBatch(votes, log_weights, best, score)

    def list_object_points(
        self, output: ParticleOutput, point: Tensor, center: Tensor, radius: float
    ) -> tuple[Tensor, Tensor]:
        """Return the candidate object points of each particle's own point.

        Returns:
            Probabilities (B, N, k), and positions (B, N, k, 3) from the object's center, in radii.
        """
        fragments = output.fragments
        if fragments is None:
            object_point = transform(invert(output.pose.detach()), point[:, :, None])
            return torch.ones_like(object_point[..., 0]), (object_point - center) / radius
        count = min(self.top_fragments, fragments.log_prob.shape[-1])
        log_prob, index = fragments.log_prob.detach().topk(count, dim=-1)
        index = index[..., None].expand(-1, -1, -1, 3)
        return log_prob.exp(), fragments.position.detach().gather(2, index)

    @staticmethod
    def _inliers(pose: Tensor, object_point: Tensor, point: Tensor, scale: float) -> Tensor:
        """Return the Geman-McClure weight of each correspondence under each pose.

        (*, 4, 4), object points (*, N, k, 3), measured points in the camera (*, N, 3), the scale of
        the residuals [m] -> (*, N, k) in (0, 1].
        """
        points = transform(pose, object_point.flatten(-3, -2))
        offset = points.unflatten(-2, object_point.shape[-3:-1]) - point[..., None, :]
        return 1 / (1 + offset.square().sum(-1) / scale**2).square()
