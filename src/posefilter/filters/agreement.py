"""The pose that most particles' own surface points agree on."""

from typing import Protocol

import torch
from torch import Generator, Tensor

from posefilter.contracts import Method, Scene
from posefilter.geometry.pose import fit_rigid, invert, transform
from posefilter.types import Belief, Cloud, Reading


class SeesPoints(Protocol):
    """A method whose particles each stand on one measured point."""

    def own_points(self, scene: Scene, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return each particle's camera point (B, N, 3) [m], and whether its depth was measured (B, N) bool."""
        ...


class Agreement:
    """Bet on the pose that the particles' own points agree on, weighted by their likelihoods.

    A particle's pose says which object point its own measured point is: one correspondence a particle. Each of the likeliest
    `hypotheses` particles' poses is scored by how many correspondences it explains, and the best is refitted to all of them
    (Kabsch, reweighted by how well each fits, with a falling scale). scale_m: how far a correspondence may lie off [m].
    """

    def __init__(self, scale_m: float = 0.015, hypotheses: int = 64, rounds: int = 8) -> None:
        self.scale_m = scale_m
        self.hypotheses = hypotheses
        self.rounds = rounds

    def __call__(self, cloud: Cloud, reading: Reading, scene: Scene, method: Method, generator: Generator) -> Belief:
        """Return the belief whose `best` is the agreed pose, its score the share that agrees x the best likelihood."""
        point, known = method.own_points(scene, cloud.state)  # type: ignore[attr-defined]
        thing = transform(invert(reading.pose), point[:, :, None])[:, :, 0]
        weight = reading.log_likelihood.exp() * known + 1e-9
        start = weight.topk(min(self.hypotheses, weight.shape[1]), dim=1).indices
        guess = reading.pose.gather(1, start[..., None, None].expand(-1, -1, 4, 4))
        explained = weight[:, None] * self._fit(guess, thing[:, None], point[:, None], 2 * self.scale_m)
        best = guess.gather(1, explained.sum(-1).argmax(1)[:, None, None, None].expand(-1, -1, 4, 4))[:, 0]
        for i in range(self.rounds):
            scale = self.scale_m * 2 ** (2 - 2 * i / max(self.rounds - 1, 1))
            best = fit_rigid(thing, point, weight * self._fit(best, thing, point, scale))
        near = self._fit(best, thing, point, self.scale_m) > 0.04  # within two scales
        agreed = (weight * near).sum(1) / weight.sum(1)
        log_weights = torch.log_softmax(reading.log_likelihood, dim=1)
        return Belief(reading.pose, log_weights, best, agreed * reading.log_likelihood.exp().max(1).values)

    @staticmethod
    def _fit(pose: Tensor, thing: Tensor, point: Tensor, scale: float) -> Tensor:
        """How well poses explain correspondences, in (0, 1].  (*, 4, 4), (*, N, 3), (*, N, 3) [m] -> (*, N)."""
        square = (transform(pose, thing) - point).square().sum(-1)
        return 1 / (1 + square / scale**2).square()
