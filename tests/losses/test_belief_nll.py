"""Density of the truth under weighted particles: its value, and how far its gradient reaches."""

import math
from typing import Any

import pytest
import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.filters.estimate import Argmax
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.propagate import LearnedDisplacement
from posefilter.filters.refine import NoRefine
from posefilter.filters.resample import NoResampling, Soft, Systematic
from posefilter.filters.reweight import CurrentLikelihood, LikelihoodRatio, SequentialBayes
from posefilter.filters.schedule import Constant
from posefilter.filters.transport import EnsembleTransform
from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import exp_so3
from posefilter.geometry.spaces import PixelSpace
from posefilter.losses.belief import BeliefNll, MaskDensity, PoseDensity
from posefilter.types import Batch, ObjectModel, ParticleOutput, Particles, Resampled, Step, Trace

HALF_TURN = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))


def weigh(trace: Trace, weights: list[float]) -> Trace:
    """Return a trace whose particles have given weights at every step."""
    log_weights = torch.tensor([weights], dtype=torch.float64).log()
    return trace._replace(
        particles=tuple(p._replace(log_weights=log_weights) for p in trace.particles)
    )


def at(place: tuple[float, ...], turn: tuple[float, ...] = (0, 0, 0)) -> Tensor:
    return make_pose(exp_so3(torch.tensor(turn).double()), torch.tensor(place).double())


def test_the_density_of_two_pixels_by_hand(batch, model, make_trace) -> None:
    mask = torch.zeros_like(batch.mask)
    mask[0, 0, 3, [6, 9]] = True
    trace = weigh(make_trace(torch.tensor([[[6.0, 3.0], [8.0, 5.0]]]).double()), [0.75, 0.25])
    loss = BeliefNll({"mask": MaskDensity(sigma=0.1)})  # 2 px of 20
    norm = 2 * math.pi * 0.01
    near = 0.75 + 0.25 * math.exp(-(4 + 4) / 8)
    far = 0.75 * math.exp(-9 / 8) + 0.25 * math.exp(-(1 + 4) / 8)
    want = -(math.log(near / norm) + math.log(far / norm)) / 2
    own = batch._replace(mask=mask)
    assert loss(trace, own, model).item() == pytest.approx(want)
    assert loss(trace, own._replace(mask=mask & False), model).item() == 0


def test_the_kernel_of_poses_is_a_density_and_near_zero_a_gaussian() -> None:
    """Integrated over SO(3) of volume pi^2, whose turns by an angle a weigh (1 - cos a) / pi."""
    for degrees in (5.0, 40.0, 120.0):
        density = PoseDensity(translation_mm=30.0, rotation_deg=degrees)
        angle = torch.linspace(0, math.pi, 20_001, dtype=torch.float64)
        turned = make_pose(
            exp_so3(angle[:, None] * torch.tensor([0.0, 0.6, 0.8])), torch.zeros(3).double()
        )
        here = torch.eye(4, dtype=torch.float64)
        log_kernel = density.log_kernel(here, turned, torch.zeros(3))
        shift = 1.5 * math.log(2 * math.pi * 0.03**2)  # of the position, at its peak
        over = math.pi * torch.trapezoid((log_kernel + shift).exp() * (1 - angle.cos()), angle)
        assert over.item() == pytest.approx(1, abs=1e-4)
        small = math.radians(0.2 * degrees)
        fall = log_kernel[0] - density.log_kernel(
            here, at((0, 0, 0), (0, small, 0)), torch.zeros(3)
        )
        assert fall.item() == pytest.approx(0.5 * 0.2**2, rel=0.02)
    moved = density.log_kernel(here, at((0.03, 0, 0.06)), torch.zeros(3))
    assert (log_kernel[0] - moved).item() == pytest.approx(0.5 * (1 + 4))


def test_weights_mix_the_poses_and_symmetries_share_the_density(batch, model, make_trace) -> None:
    term = PoseDensity(translation_mm=20.0, rotation_deg=10.0)
    loss = BeliefNll({"pose": term})
    truth = at((0, 0, 1))
    wrong = at((0.02, 0, 1))
    pose = torch.stack([truth, wrong])[None]
    state = torch.zeros(1, 2, 2).double()
    for weights in ([0.9, 0.1], [0.2, 0.8]):
        trace = weigh(make_trace(state, pose=pose), weights)
        peak = term.log_scale
        want = -(peak + math.log(weights[0] + weights[1] * math.exp(-0.5)))
        assert loss(trace, batch, model).item() == pytest.approx(want)
    double = model._replace(symmetries=torch.stack([torch.eye(4), HALF_TURN]))
    found = [
        loss(make_trace(state, pose=(truth @ turn)[None, None].expand(1, 2, 4, 4)), batch, double)
        for turn in double.symmetries.double()
    ]
    assert found[0].item() == pytest.approx(found[1].item())
    assert found[0].item() == pytest.approx(-term.log_scale + math.log(2))


def test_steps_are_last_or_all(batch, model, make_trace) -> None:
    with pytest.raises(UserError, match="last or all"):
        BeliefNll({}, steps="first")
    trace = make_trace(torch.tensor([[[12.0, 3.0]], [[6.0, 3.0]]]).double())
    terms = {"mask": MaskDensity()}
    last = BeliefNll(terms, "last")(trace, batch, model)
    assert last < BeliefNll(terms)(trace, batch, model)
    only = make_trace(torch.tensor([[[6.0, 3.0]]]).double())
    assert last.item() == pytest.approx(BeliefNll(terms)(only, batch, model).item())


def test_the_gradient_is_that_of_the_density(batch, model, make_trace) -> None:
    g = Generator().manual_seed(0)
    state = (torch.rand(1, 3, 2, generator=g).double() * 8).requires_grad_()
    logits = torch.randn(1, 3, generator=g).double().requires_grad_()
    turn = (0.3 * torch.randn(3, 6, generator=g).double()).requires_grad_()
    loss = BeliefNll({"mask": MaskDensity(), "pose": PoseDensity()})

    def value(state: Tensor, logits: Tensor, turn: Tensor) -> Tensor:
        pose = make_pose(exp_so3(turn[:, 3:]), turn[:, :3])[None]
        trace = make_trace(state, pose=pose)
        particles = trace.particles[0]._replace(log_weights=logits.log_softmax(1))
        return loss(trace._replace(particles=(particles,)), batch, model)

    assert torch.autograd.gradcheck(value, (state, logits, turn))


class Taste:
    """Likes pixels by a linear taste at the first step alone, and moves by a pull at each."""

    space, latent_width = PixelSpace(), 0

    def __init__(self, taste: Tensor, pull: Tensor) -> None:
        self.taste, self.pull = taste, pull

    def encode(self, batch: Batch) -> None:
        return None

    def measure(
        self, encoding: None, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        state = particles.state
        like = (state / 20) @ self.taste
        fixed = -0.01 * (state - 9).square().sum(-1)
        B, N = state.shape[:2]
        move = self.pull * (state.new_tensor([6.0, 3.0]) - state)
        pose = torch.eye(4, dtype=state.dtype).expand(B, N, 4, 4)
        return ParticleOutput(like if step.number == 0 else fixed, move, pose, particles.latent)


class Frozen:
    """Soft resampling whose draws are those of its first run: what its gradient is defined by."""

    def __init__(self) -> None:
        self.drawn: list[tuple[Tensor, Tensor]] = []
        self.turn = 0

    def __call__(self, particles: Particles, *rest: Any) -> Resampled:
        log_w = particles.log_weights
        if self.turn == len(self.drawn):
            new = Soft(0.5)(particles, *rest)
            log_q = (log_w.gather(1, new.ancestors) - new.log_weights).detach()  # up to a constant
            self.drawn.append((new.ancestors, log_q))
        ancestors, log_q = self.drawn[self.turn]
        self.turn += 1
        return Resampled(ancestors, (log_w.gather(1, ancestors) - log_q).log_softmax(1))


def roll_out(resample: Any, reweight: Any = None, steps: str = "last") -> Any:
    """Return the loss of three steps of a filter as a function of taste (2,) and pull ()."""

    def start(batch: Batch, *rest: Any) -> Tensor:
        g = Generator().manual_seed(3)
        return torch.rand(1, 16, 2, generator=g).double() * torch.tensor([20.0, 10.0])

    filter = ParticleFilter(
        16, 3, start, Constant(1.0), reweight or SequentialBayes(), resample, LearnedDisplacement(),
        Argmax(), NoRefine(),
    )  # fmt: skip

    def value(taste: Tensor, pull: Tensor, batch: Batch, object_model: ObjectModel) -> Tensor:
        if isinstance(resample, Frozen):
            resample.turn = 0
        trace = filter(batch, Taste(taste, pull), Generator().manual_seed(5))
        return BeliefNll({"mask": MaskDensity(0.1)}, steps)(trace, batch, object_model)

    return value


def tastes() -> tuple[Tensor, Tensor]:
    taste = torch.tensor([0.7, -0.4], dtype=torch.float64, requires_grad=True)
    return taste, torch.tensor(0.1, dtype=torch.float64, requires_grad=True)


@pytest.mark.parametrize(
    "resample", [EnsembleTransform(), EnsembleTransform(0.5, 5), Frozen(), NoResampling()],
    ids=["transport", "blunt transport", "soft", "none"],
)  # fmt: skip
def test_the_last_belief_teaches_the_first_likelihood(resample, batch, model) -> None:
    """By finite differences, through two resamplings. With soft resampling the draws are held."""
    value = roll_out(resample)
    taste, pull = tastes()
    assert torch.autograd.gradcheck(lambda t: value(t, pull.detach(), batch, model), (taste,))
    (slope,) = torch.autograd.grad(value(taste, pull, batch, model).sum(), taste)
    assert slope.norm() > 0.01
    if isinstance(resample, Frozen):  # and soft resampling itself has that gradient
        soft = roll_out(Soft(0.5))(taste, pull, batch, model).sum()
        torch.testing.assert_close(torch.autograd.grad(soft, taste)[0], slope)


@pytest.mark.parametrize("resample", [Soft(0.5), Systematic()], ids=["soft", "systematic"])
@pytest.mark.parametrize(
    "reweight",
    [SequentialBayes(), CurrentLikelihood(), LikelihoodRatio()],
    ids=lambda r: type(r).__name__,
)
def test_what_stops_the_gradient_to_the_first_likelihood(resample, reweight, batch, model) -> None:
    """A choice of ancestors has no gradient. The weights that soft resampling hands down have one,
    which annealed weights forget; the ratio of likelihoods divides it out again.
    """
    taste, pull = tastes()
    loss = roll_out(resample, reweight)(taste, pull, batch, model).sum()
    slopes = torch.autograd.grad(loss, (taste, pull), allow_unused=True)
    reached = 0.0 if slopes[0] is None else float(slopes[0].norm())
    if isinstance(resample, Soft) and isinstance(reweight, SequentialBayes):
        assert reached > 0.01
    elif not isinstance(reweight, LikelihoodRatio) or isinstance(resample, Soft):
        assert reached == pytest.approx(0, abs=1e-12)
    assert float(slopes[1].abs()) > 0.01, "displacements learn with each"
