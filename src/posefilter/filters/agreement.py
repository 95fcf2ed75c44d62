"""The pose that most particles' own surface points agree on."""

import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.geometry.pose import fit_rigid, invert, transform
from posefilter.geometry.votes import draw_votes
from posefilter.protocols import HasSurfacePoints, Method, Scene
from posefilter.types import Belief, ParticleOutput, Particles


def surface_points_of(method: Method) -> HasSurfacePoints:
    """Return the method as one whose particles stand on measured points; raise UserError if they do
    not.
    """
    if not isinstance(method, HasSurfacePoints):
        raise UserError(
            f"estimate=agreement: no particle of {type(method).__name__} stands on a measured "
            f"point; choose estimate=argmax"
        )
    return method


class Agreement:
    """Bet on the pose that the particles' own points agree on, weighted by their likelihoods.

    A particle says which object point its own measured point is: by its pose, or by its likeliest
    `options` fragments where it tells fragments. Hypotheses are the likeliest particles' own poses,
    and as many votes: a few particles' points at a time. Each is scored by how many particles it
    explains, and the best is refitted to all of them (Kabsch, reweighted by how well each fits,
    with a falling scale). The belief is the votes, each weighted by the share that it explains to
    the power of `counts`: as many particles count as independent.

    scale_m: how far a particle's point may lie off [m]; hypotheses: of each kind; rounds: of the
    refit.
    """

    def __init__(
        self,
        scale_m: float = 0.015,
        hypotheses: int = 64,
        rounds: int = 8,
        options: int = 3,
        counts: float = 8.0,
    ) -> None:
        if min(hypotheses, options) < 1 or scale_m <= 0:
            raise UserError(
                f"estimate: hypotheses={hypotheses} and options={options} must be 1 or more, and "
                f"scale_m={scale_m} above 0"
            )
        self.scale_m = scale_m
        self.hypotheses = hypotheses
        self.rounds = rounds
        self.options = options
        self.counts = counts

    def __call__(
        self,
        particles: Particles,
        output: ParticleOutput,
        scene: Scene,
        method: Method,
        generator: Generator,
    ) -> Belief:
        """Return the belief whose `best` is the agreed pose, its score the share that agrees x the
        best likelihood.
        """
        sees = surface_points_of(method)
        center, radius = sees.model.center.to(particles.state), sees.model.radius
        point, known = sees.surface_points(scene, particles.state)
        share, place = self._options(output, point, center, radius)
        weight = output.log_likelihood.detach().exp() * known
        votes = draw_votes(point, weight, share, place, center, radius, self.hypotheses, generator)
        weight = weight + 1e-9  # where none is known, all are
        start = weight.topk(min(self.hypotheses, weight.shape[1]), dim=1).indices
        likeliest = output.pose.detach().gather(1, start[..., None, None].expand(-1, -1, 4, 4))
        guess = torch.cat([votes, likeliest], dim=1)
        thing = center + radius * place
        fits = (
            share[:, None] * self._fit(guess, thing[:, None], point[:, None], 2 * self.scale_m)
        ).sum(-1)
        explained = (weight[:, None] * fits).sum(-1)
        best = guess.gather(1, explained.argmax(1)[:, None, None, None].expand(-1, -1, 4, 4))[:, 0]
        for i in range(self.rounds):
            scale = self.scale_m * 2 ** (2 - 2 * i / max(self.rounds - 1, 1))
            fit, option = (share * self._fit(best, thing, point, scale)).max(-1)
            chosen = thing.gather(2, option[..., None, None].expand(-1, -1, 1, 3))[:, :, 0]
            best = fit_rigid(chosen, point, weight * fit)
        # within two scales
        near = (share * (self._fit(best, thing, point, self.scale_m) > 0.04)).sum(-1)
        agreed = (weight * near).sum(1) / weight.sum(1)
        log_weights = torch.log_softmax(
            self.counts * explained[:, : self.hypotheses].clamp_min(1e-30).log(), dim=1
        )
        return Belief(votes, log_weights, best, agreed * output.log_likelihood.exp().max(1).values)

    def _options(
        self, output: ParticleOutput, point: Tensor, center: Tensor, radius: float
    ) -> tuple[Tensor, Tensor]:
        """Return what each particle's own point may be.  -> shares (B, N, k), places over the
        radius (B, N, k, 3).
        """
        said = output.fragments
        if said is None:
            thing = transform(invert(output.pose.detach()), point[:, :, None])
            return torch.ones_like(thing[..., 0]), (thing - center) / radius
        log_share, fragment = said.log_share.detach().topk(
            min(self.options, said.log_share.shape[-1]), dim=-1
        )
        return log_share.exp(), said.place.detach().gather(
            2, fragment[..., None].expand(-1, -1, -1, 3)
        )

    @staticmethod
    def _fit(pose: Tensor, thing: Tensor, point: Tensor, scale: float) -> Tensor:
        """How well poses explain what particles say, in (0, 1].

        (*, 4, 4), (*, N, k, 3), (*, N, 3) [m] -> (*, N, k).
        """
        there = transform(pose, thing.flatten(-3, -2)).unflatten(-2, thing.shape[-3:-1])
        return 1 / (1 + (there - point[..., None, :]).square().sum(-1) / scale**2).square()
