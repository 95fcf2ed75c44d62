"""Refinements of the estimate: rescoring particles, mean shift, gradient ascent; particles stay."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Generator, Tensor

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.geometry.pose import take_poses
from posefilter.protocols import Encoding, HasObject, Method, Refine, ScoresPoses
from posefilter.types import BeliefBatch, ObjectModel

_RESCORED = (
    "log-likelihood of the refined estimate, up to a constant of the image and of its image "
    "points; no probability"
)


class NoRefine:
    """Leave the estimate unchanged."""

    def __call__(
        self, belief: BeliefBatch, encoding: Encoding, method: Method, generator: Generator
    ) -> BeliefBatch:
        """Return the belief unchanged."""
        return belief


class Compose:
    """Apply several refinements one after the other."""

    def __init__(self, components: Iterable[Refine]) -> None:
        self.components = list(components)

    @property
    def score_is(self) -> str:
        """What the last refinement that scores anew says; empty where none does."""
        descriptions = [getattr(component, "score_is", "") for component in self.components]
        return next(filter(None, reversed(descriptions)), "")

    def __call__(
        self, belief: BeliefBatch, encoding: Encoding, method: Method, generator: Generator
    ) -> BeliefBatch:
        """Return the belief after the last refinement."""
        for component in self.components:
            belief = component(belief, encoding, method, generator)
        return belief


def scorer_of(method: Method) -> ScoresPoses:
    """Return the method as one that scores poses, as `requires` of what calls this says it does."""
    assert isinstance(method, ScoresPoses)
    return method


def object_of(method: Method) -> ObjectModel:
    """Return the method's object, which `set_object` gives to whatever estimates poses."""
    assert isinstance(method, HasObject)
    return method.object_model


def top_poses(belief: BeliefBatch, count: int) -> Tensor:
    """Return the estimate and the `count` particles of highest weight.  -> (B, 1 + count, 4, 4)."""
    top = belief.log_weights.topk(min(count, belief.log_weights.shape[1]), dim=1).indices
    return torch.cat([belief.best[:, None], take_poses(belief.poses, top)], dim=1)


def select_best(belief: BeliefBatch, poses: Tensor, scores: Tensor) -> BeliefBatch:
    """Return the belief with the pose of highest score as its estimate.  (B, C, 4, 4), (B, C)."""
    score, index = scores.max(1)
    return belief._replace(best=take_poses(poses, index[:, None])[:, 0], score=score)


@dataclass(eq=False)
class Rescore:
    """Score the estimate and the heaviest particles again with more pixels, and select the best.

    Args:
        top_k: Particles to score.
        pixels: Image points for each score.
        sigma: Noise level of the likelihood [m].
    """

    requires: ClassVar[Capabilities] = ("score_poses",)
    score_is: ClassVar[str] = _RESCORED

    top_k: int = 20
    pixels: int = 1024
    sigma: float = 0.004

    def __call__(
        self, belief: BeliefBatch, encoding: Encoding, method: Method, generator: Generator
    ) -> BeliefBatch:
        """Return the belief with the pose of highest score as its estimate."""
        scorer, poses = scorer_of(method), top_poses(belief, self.top_k)
        with torch.no_grad():
            scores = scorer.score_poses(encoding, poses, self.sigma, generator, self.pixels)
        return select_best(belief, poses, scores)


@dataclass(eq=False)
class MeanShift:
    """Shift the estimate to the likelihood-weighted mean around it (Comaniciu and Meer 2002).

    A learned likelihood is flat and noisy at its maximum, where gradient ascent stops at a local
    maximum. The mean over a neighborhood does not, and it has the least expected squared error.
    Perturbations come in antithetic pairs, so a constant likelihood leaves the estimate in place.

    Args:
        iterations: Number of shifts.
        antithetic_pairs: Pairs of opposite perturbations in an iteration.
        initial_scale: Standard deviation in the first iteration [m on the object's surface].
        final_scale: Standard deviation in the last iteration; geometric between.
        sigma: Noise level of the likelihood [m].
        pixels: Image points for each score, drawn anew in each iteration.

    Raises:
        UserError: A number is out of range.
    """

    requires: ClassVar[Capabilities] = ("score_poses",)
    score_is: ClassVar[str] = _RESCORED

    iterations: int = 4
    antithetic_pairs: int = 24
    initial_scale: float = 0.012
    final_scale: float = 0.007
    sigma: float = 0.004
    pixels: int = 256

    def __post_init__(self) -> None:
        low, high = self.final_scale, self.initial_scale
        if self.iterations < 1 or self.antithetic_pairs < 1 or not 0 < low <= high:
            raise UserError(
                f"refine: a mean shift needs iterations and antithetic_pairs >= 1 and "
                f"0 < final_scale <= initial_scale, got {low} and {high}"
            )

    @torch.no_grad()
    def __call__(
        self, belief: BeliefBatch, encoding: Encoding, method: Method, generator: Generator
    ) -> BeliefBatch:
        """Return the belief with the estimate shifted; without gradient."""
        scorer, best = scorer_of(method), belief.best
        for index in range(self.iterations):
            fraction = index / max(self.iterations - 1, 1)
            spread = self.initial_scale * (self.final_scale / self.initial_scale) ** fraction
            scale = method.space.noise_scale(best.new_tensor(spread))
            shape = (len(best), self.antithetic_pairs, method.space.dimensions)
            noise = torch.randn(shape, generator=generator, device=best.device, dtype=best.dtype)
            moves = torch.cat([noise, -noise], dim=1) * scale
            copies = best[:, None].expand(-1, 2 * self.antithetic_pairs, -1, -1)
            poses = method.space.move(copies, moves)
            scores = scorer.score_poses(encoding, poses, self.sigma, generator, self.pixels)
            best = method.space.move(best, (scores.softmax(1)[..., None] * moves).sum(1))
        score = scorer.score_poses(encoding, best[:, None], self.sigma, generator, self.pixels)
        return belief._replace(best=best, score=score[:, 0])


@dataclass(eq=False)
class Gradient:
    """Maximize the score by Adam (Kingma and Ba 2015) on the pose's tangent.

    It starts from the estimate and the heaviest particles. The unrefined estimate takes part in the
    last comparison, so it is replaced only by a pose of higher score.

    Args:
        steps: Number of gradient steps.
        lr: Length of the first steps on the object's surface [m]; falls linearly to 0.
        sigma: Noise level of the score that is maximized [m].
        pixels: Image points for each score, drawn anew at each step.
        starts: Poses to start from.
        final_pixels: Image points for the last comparison.
        final_sigma: Noise level of the last comparison [m].
    """

    requires: ClassVar[Capabilities] = ("score_poses",)
    score_is: ClassVar[str] = _RESCORED

    steps: int = 50
    lr: float = 2e-3
    sigma: float = 0.006
    pixels: int = 256
    starts: int = 1
    final_pixels: int = 1024
    final_sigma: float = 0.004

    def __call__(
        self, belief: BeliefBatch, encoding: Encoding, method: Method, generator: Generator
    ) -> BeliefBatch:
        """Return the belief with a refined estimate; without gradient.

        Raises:
            UserError: Gradients are disabled by inference mode.
        """
        scorer = scorer_of(method)
        if torch.is_inference_mode_enabled():
            raise UserError(
                "refine: gradient ascent needs gradients; set trainer.inference_mode=false"
            )
        start = top_poses(belief, self.starts - 1).detach()
        refined = self.climb(start, encoding, method, scorer, generator)
        poses = torch.cat([start[:, :1], refined], dim=1)
        with torch.no_grad():
            scores = scorer.score_poses(
                encoding, poses, self.final_sigma, generator, self.final_pixels
            )
        return select_best(belief, poses, scores)

    def climb(
        self,
        start: Tensor,
        encoding: Encoding,
        method: Method,
        scorer: ScoresPoses,
        generator: Generator,
    ) -> Tensor:
        """Return the poses after gradient ascent.  (B, C, 4, 4) -> (B, C, 4, 4)."""
        # a turn counts as the shift at the radius
        unit = method.space.noise_scale(start.new_tensor(self.lr)) / self.lr
        with torch.enable_grad():
            x = torch.zeros(
                *start.shape[:2], method.space.dimensions, device=start.device, requires_grad=True
            )
            adam = torch.optim.Adam([x], self.lr)
            for step in range(self.steps):
                adam.param_groups[0]["lr"] = self.lr * (1 - step / self.steps)
                poses = method.space.move(start, x * unit)
                score = scorer.score_poses(encoding, poses, self.sigma, generator, self.pixels)
                # of x alone: the network's own gradients stay untouched
                (x.grad,) = torch.autograd.grad(-score.sum(), x)
                adam.step()
        return method.space.move(start, x.detach() * unit)
