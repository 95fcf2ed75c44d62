"""Polishing an estimate: scoring the best few particles with more care, then a mean shift, or a
climb of the gradient.
"""

from collections.abc import Iterable

import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.protocols import Method, Refine, Scene, ScoresPoses
from posefilter.types import Belief


class NoRefine:
    """Leave the estimate as it is."""

    def __call__(
        self, belief: Belief, scene: Scene, method: Method, generator: Generator
    ) -> Belief:
        """Return the belief."""
        return belief


class Chain:
    """Apply several refinements one after the other."""

    def __init__(self, pieces: Iterable[Refine]) -> None:
        self.pieces = list(pieces)

    def __call__(
        self, belief: Belief, scene: Scene, method: Method, generator: Generator
    ) -> Belief:
        """Return what the last piece makes of it."""
        for piece in self.pieces:
            belief = piece(belief, scene, method, generator)
        return belief


def scorer(method: Method) -> ScoresPoses:
    """Return the method as one that scores poses; raise UserError if it cannot."""
    if not isinstance(method, ScoresPoses):
        raise UserError(
            f"refine: {type(method).__name__} cannot score poses on their own; choose refine=none"
        )
    return method


def candidates(belief: Belief, count: int) -> Tensor:
    """Return the estimate, and the `count` particles of most weight.  -> (B, 1 + count, 4, 4)."""
    top = belief.log_weights.topk(min(count, belief.log_weights.shape[1]), dim=1).indices
    rows = torch.arange(len(top), device=top.device)[:, None]
    return torch.cat([belief.best[:, None], belief.poses[rows, top]], dim=1)


def bet_on_highest(belief: Belief, poses: Tensor, scores: Tensor) -> Belief:
    """Return the belief with the highest-scored pose as its estimate.  (B, C, 4, 4), (B, C)."""
    score, index = scores.max(1)
    return belief._replace(
        best=poses[torch.arange(len(index), device=index.device), index], score=score
    )


class Rescore:
    """Score the estimate and the `top` heaviest particles at `sigma` with many pixels, and bet on
    the best of them.
    """

    def __init__(self, top: int = 20, pixels: int = 1024, sigma: float = 0.004) -> None:
        self.top, self.pixels, self.sigma = top, pixels, sigma

    def __call__(
        self, belief: Belief, scene: Scene, method: Method, generator: Generator
    ) -> Belief:
        """Return the belief with a better-founded estimate."""
        poses = candidates(belief, self.top)
        with torch.no_grad():
            scores = scorer(method).score_poses(scene, poses, self.sigma, generator, self.pixels)
        return bet_on_highest(belief, poses, scores)


class MeanShift:
    """Go to the mean of the poses around the estimate, weighed by their likelihood, in rounds
    (Comaniciu and Meer 2002).

    A learned likelihood is flat and bumpy at its top, where a climb stops at a bump; the mean over
    a neighborhood does not, and it is the estimate of least squared error.

    pairs: poses drawn to either side of the estimate; start, end: their spread [m on the object's
    surface] in the first and the last round, geometric between; sigma: noise level of the
    likelihood [m]; pixels: drawn anew each round.
    """

    def __init__(
        self,
        rounds: int = 8,
        pairs: int = 32,
        start: float = 0.012,
        end: float = 0.007,
        sigma: float = 0.004,
        pixels: int = 256,
    ) -> None:
        if rounds < 1 or pairs < 1 or not 0 < end <= start:
            raise UserError(
                f"refine: a mean shift needs rounds and pairs >= 1 and 0 < end <= "
                f"start, got {end} and {start}"
            )
        self.rounds, self.pairs, self.start, self.end = rounds, pairs, start, end
        self.sigma, self.pixels = sigma, pixels

    @torch.no_grad()
    def __call__(
        self, belief: Belief, scene: Scene, method: Method, generator: Generator
    ) -> Belief:
        """Return the belief with the estimate shifted."""
        judge, best = scorer(method), belief.best
        for round_ in range(self.rounds):
            spread = self.start * (self.end / self.start) ** (round_ / max(self.rounds - 1, 1))
            scale = method.space.noise_scale(best.new_tensor(spread))
            draw = torch.randn(
                len(best),
                self.pairs,
                method.space.dimensions,
                generator=generator,
                device=best.device,
                dtype=best.dtype,
            )
            # pairs: an even likelihood then moves the estimate nowhere
            moves = torch.cat([draw, -draw], dim=1) * scale
            poses = method.space.move(best[:, None].expand(-1, 2 * self.pairs, -1, -1), moves)
            weights = judge.score_poses(scene, poses, self.sigma, generator, self.pixels).softmax(1)
            best = method.space.move(best, (weights[..., None] * moves).sum(1))
        score = judge.score_poses(scene, best[:, None], self.sigma, generator, self.pixels)[:, 0]
        return belief._replace(best=best, score=score)


class Gradient:
    """Climb the score by Adam on the pose's tangent, from the estimate and the heaviest other
    particles.

    starts: poses that climb side by side; lr: the first steps' length on the object's surface [m],
    falling linearly to 0; sigma: noise level of the score climbed [m]; pixels: drawn anew at each
    step; final_pixels: for the last comparison, at `final_sigma`, in which the unrefined estimate
    takes part, so that it is only left for something that scores higher.
    """

    def __init__(
        self,
        steps: int = 50,
        lr: float = 2e-3,
        sigma: float = 0.006,
        pixels: int = 256,
        starts: int = 1,
        final_pixels: int = 1024,
        final_sigma: float = 0.004,
    ) -> None:
        self.steps, self.lr, self.sigma, self.pixels, self.starts = steps, lr, sigma, pixels, starts
        self.final_pixels, self.final_sigma = final_pixels, final_sigma

    def __call__(
        self, belief: Belief, scene: Scene, method: Method, generator: Generator
    ) -> Belief:
        """Return the belief with a refined estimate, without gradient."""
        judge = scorer(method)
        if torch.is_inference_mode_enabled():
            raise UserError(
                "refine: climbing the score needs gradients; set trainer.inference_mode=false"
            )
        start = candidates(belief, self.starts - 1).detach()
        found = self.climb(start, scene, method, judge, generator)
        poses = torch.cat([start[:, :1], found], dim=1)
        with torch.no_grad():
            scores = judge.score_poses(scene, poses, self.final_sigma, generator, self.final_pixels)
        return bet_on_highest(belief, poses, scores)

    def climb(
        self, start: Tensor, scene: Scene, method: Method, judge: ScoresPoses, generator: Generator
    ) -> Tensor:
        """Return where each pose climbs to.  (B, C, 4, 4) -> (B, C, 4, 4)."""
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
                score = judge.score_poses(scene, poses, self.sigma, generator, self.pixels)
                # of x alone: the network's own gradients stay untouched
                (x.grad,) = torch.autograd.grad(-score.sum(), x)
                adam.step()
        return method.space.move(start, x.detach() * unit)
