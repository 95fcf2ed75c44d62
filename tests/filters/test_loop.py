"""The loop: what goes from step to step, what stays apart, and what is the same again."""

import math
from types import SimpleNamespace

import pytest
import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.filters.auxiliary import AuxiliaryResampling
from posefilter.filters.estimate import Argmax, Mean
from posefilter.filters.loop import ParticleFilter, inherit
from posefilter.filters.propagate import Compose, Gaussian, Identity, LearnedDisplacement
from posefilter.filters.refine import NoRefine
from posefilter.filters.resample import AdaptiveResampling, NoResampling, Soft, Systematic
from posefilter.filters.reweight import CurrentLikelihood, LikelihoodRatio, SequentialBayes
from posefilter.filters.schedule import Constant, Geometric
from posefilter.filters.transport import EnsembleTransform, SampledTransport
from posefilter.geometry.spaces import PixelSpace
from posefilter.metrics.diagnostics import distinct
from posefilter.protocols import Resample
from posefilter.types import ParticleOutput, Particles, Resampled, Step

EYE = torch.eye(4)


class Hill:
    """A method that likes one place an image; its displacement is a learned share of the way there,
    its latent counts steps.
    """

    space = PixelSpace()
    latent_width = 2

    def __init__(self, goal: Tensor, pull: float = 0.0) -> None:
        self.goal = goal
        self.pull = torch.tensor(pull, requires_grad=True)
        self.seen: list[Particles] = []

    def encode(self, batch: None) -> Tensor:
        return self.goal

    def measure(
        self, encoding: Tensor, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        self.seen.append(particles)
        way = encoding[:, None] - particles.state
        pose = EYE.expand(*way.shape[:2], 4, 4).clone()
        pose[..., :2, 3] = particles.state
        latent = torch.stack([particles.latent[..., 0] + 1, particles.state[..., 0].detach()], -1)
        return ParticleOutput(-0.5 * way.square().sum(-1), self.pull * way, pose, latent)


def start(
    batch: None, encoding: Tensor, method: Hill, particles: int, generator: Generator
) -> Tensor:
    return 3 * torch.randn(len(encoding), particles, 2, generator=generator)


def build(
    resample: Resample | None = None, particles: int = 50, **changes: object
) -> ParticleFilter:
    pieces = {
        "initialize": start,
        "schedule": Constant(0.5),
        "reweight": SequentialBayes(),
        "resample": resample or Systematic(),
        "propagate": Compose([LearnedDisplacement(), Gaussian(0.4)]),
        "estimate": Mean(),
        "refine": NoRefine(),
    }
    return ParticleFilter(particles, 4, **(pieces | changes))


GOALS = torch.tensor([[1.0, 2.0], [-1.0, 0.5], [0.0, 0.0]])
every = pytest.mark.parametrize(
    "resample",
    [
        Systematic(),
        Soft(),
        AdaptiveResampling(Systematic()),
        SampledTransport(),
        EnsembleTransform(),
    ],
    ids=lambda x: type(x).__name__,
)


@every
def test_same_generator_same_belief(resample: Resample) -> None:
    a, b, c = (
        build(resample)(None, Hill(GOALS), Generator().manual_seed(seed)).belief
        for seed in (1, 1, 2)
    )
    assert all(torch.equal(x, y) for x, y in zip(a, b, strict=True))
    assert not torch.equal(a.best, c.best)


@every
def test_nothing_is_kept_between_calls(resample: Resample) -> None:
    filt = build(resample)
    first = filt(None, Hill(GOALS), Generator().manual_seed(1)).belief
    filt(None, Hill(GOALS + 5), Generator().manual_seed(7))
    again = filt(None, Hill(GOALS), Generator().manual_seed(1)).belief
    assert all(torch.equal(x, y) for x, y in zip(first, again, strict=True))
    assert not list(filt.buffers())


@every
def test_images_do_not_see_each_other(resample: Resample) -> None:
    other = GOALS.clone()
    other[1] += 7
    a, b = (
        build(resample)(None, Hill(goals), Generator().manual_seed(1)).belief
        for goals in (GOALS, other)
    )
    for x, y in zip(a, b, strict=True):
        torch.testing.assert_close(x[[0, 2]], y[[0, 2]])
        assert not torch.allclose(x[1], y[1])


def test_every_step_is_what_its_words_say() -> None:
    """One run against a loop over images and particles that draws nothing but the same random
    numbers.
    """
    method = Hill(GOALS, pull=0.3)
    filt = build(
        Soft(0.5),
        reweight=LikelihoodRatio(),
        propagate=LearnedDisplacement(),
        schedule=Geometric(2.0, 0.5),
    )
    trace = filt(None, method, Generator().manual_seed(3))
    g = Generator().manual_seed(3)
    state = start(None, GOALS, method, 50, g)
    score = lambda x, b: -0.5 * float((GOALS[b] - x).square().sum())  # noqa: E731
    log_w = [[math.log(score_weight) for score_weight in [1 / 50] * 50] for _ in GOALS]
    before = [[0.0] * 50 for _ in GOALS]
    for t, particles in enumerate(trace.particles):
        if t:
            places = Systematic().uniforms(3, 50, g, torch.device("cpu"))
            for b in range(3):
                q = [0.5 * math.exp(w) + 0.5 / 50 for w in log_w[b]]
                ancestors = []
                for place in places[b].tolist():
                    total, parent = q[0], 0
                    while total < place:
                        parent += 1
                        total += q[parent]
                    ancestors.append(parent)
                assert particles.ancestors[b].tolist() == ancestors
                raw = [math.exp(log_w[b][p]) / q[p] for p in ancestors]
                before[b] = [score(state[b, p], b) for p in ancestors]
                log_w[b] = [math.log(r / sum(raw)) for r in raw]
                state[b] = torch.stack(
                    [state[b, p] + 0.3 * (GOALS[b] - state[b, p]) for p in ancestors]
                )
        torch.testing.assert_close(particles.state, state)
        for b in range(3):
            log_w[b] = [log_w[b][n] + score(state[b, n], b) - before[b][n] for n in range(50)]
            total = math.log(sum(math.exp(w) for w in log_w[b]))
            assert trace.log_evidence[b, t].item() == pytest.approx(total, abs=1e-4)
            log_w[b] = [w - total for w in log_w[b]]
        torch.testing.assert_close(particles.log_weights, torch.tensor(log_w), atol=1e-4, rtol=1e-4)
    assert [float(step.sigma) for step in trace.steps] == pytest.approx(
        [2.0, 2 ** (1 / 3), 2 ** (-1 / 3), 0.5]
    )
    assert [(step.number, step.steps) for step in trace.steps] == [(t, 4) for t in range(4)]


def test_a_latent_follows_its_particle() -> None:
    method = Hill(GOALS)
    trace = build(propagate=Identity())(None, method, Generator().manual_seed(0))
    for t, particles in enumerate(trace.particles):
        assert (particles.latent[..., 0] == t).all()
        if t:  # still particles remember where they, or rather their parents, were
            torch.testing.assert_close(particles.latent[..., 1], particles.state[..., 0])
            ancestors = trace.particles[t - 1].state.gather(
                1, particles.ancestors[..., None].expand(-1, -1, 2)
            )
            torch.testing.assert_close(particles.state, ancestors)


def test_the_first_step_may_have_more_particles() -> None:
    trace = build(initial_particles=300)(None, Hill(GOALS), Generator().manual_seed(0))
    assert [particles.state.shape[1] for particles in trace.particles] == [300, 50, 50, 50]
    assert trace.particles[1].ancestors.max() >= 50
    with pytest.raises(UserError, match="initial_particles"):
        build(NoResampling(), initial_particles=300)(None, Hill(GOALS), Generator().manual_seed(0))
    with pytest.raises(UserError, match="particles=0"):
        build(particles=0)


def test_gradients_flow_as_far_as_the_pieces_let_them() -> None:
    def slope(resample: Resample, **changes: object) -> Tensor | None:
        method = Hill(GOALS, pull=0.1)
        trace = build(resample, **changes)(None, method, Generator().manual_seed(0))
        error = (trace.belief.best[:, :2, 3] - GOALS - 1).square().sum()
        return torch.autograd.grad(error, method.pull)[0]

    for resample in (Systematic(), Soft(), SampledTransport(), EnsembleTransform(), NoResampling()):
        found = slope(resample)
        assert found.isfinite()
        assert found.abs() > 1e-4
    # With all pieces smooth the slope is the finite difference's.
    step = 1e-3
    ends = []
    for pull in (0.1 - step, 0.1 + step):
        best = build(NoResampling())(
            None, Hill(GOALS, pull), Generator().manual_seed(0)
        ).belief.best
        ends.append(float((best[:, :2, 3] - GOALS - 1).square().sum().detach()))
    assert float(slope(NoResampling())) == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=0.02)


def test_soft_weights_let_the_likelihood_learn_across_a_resampling() -> None:
    class Guess(Hill):
        """Likes a learned place, the same in every image."""

        def encode(self, batch: None) -> Tensor:
            return self.pull * torch.ones_like(self.goal)

        def measure(
            self, encoding: Tensor, particles: Particles, step: Step, generator: Generator
        ) -> ParticleOutput:
            output = super().measure(
                encoding if step.number == 0 else encoding.detach(), particles, step, generator
            )
            return output._replace(displacement=output.displacement.detach())

    found = {}
    for name, resample in (("soft", Soft()), ("systematic", Systematic())):
        method = Guess(GOALS, pull=0.5)
        trace = build(resample, propagate=Identity())(None, method, Generator().manual_seed(0))
        goal = trace.belief.best[:, :2, 3].sum()
        found[name] = (
            torch.autograd.grad(goal, method.pull, allow_unused=True)[0]
            if goal.requires_grad
            else None
        )
    assert float(found["soft"]) > 0.1  # liking a place further right puts the mean further right
    assert found["systematic"] is None


@pytest.mark.parametrize("bad", [math.nan, -math.inf, math.inf])
def test_a_dead_filter_says_so(bad: float) -> None:
    class Broken(Hill):
        def measure(
            self, encoding: Tensor, particles: Particles, step: Step, generator: Generator
        ) -> ParticleOutput:
            output = super().measure(encoding, particles, step, generator)
            if step.number == 2:
                output.log_likelihood.detach()[1] = bad
            return output

    with pytest.raises(FloatingPointError, match=r"step 2 \(image 1"):
        build()(None, Broken(GOALS), Generator().manual_seed(0))


@pytest.mark.parametrize("resample", [EnsembleTransform(), AdaptiveResampling(EnsembleTransform())])
def test_a_particle_of_likelihood_zero_has_no_part_in_a_mixture(resample: Resample) -> None:
    """Likelihoods are 1 or 0, so that the ratio of a child's to its ancestors' is that, too."""

    class Half(Hill):
        def measure(
            self, encoding: Tensor, particles: Particles, step: Step, generator: Generator
        ) -> ParticleOutput:
            output = super().measure(encoding, particles, step, generator)
            away = particles.state[..., 0] > encoding[:, None, 0]
            log_p = torch.zeros_like(output.log_likelihood).masked_fill(away, -math.inf)
            return output._replace(log_likelihood=log_p)

    trace = build(resample, propagate=Identity(), reweight=LikelihoodRatio())(
        None, Half(GOALS), Generator().manual_seed(0)
    )
    assert trace.log_evidence is not None
    assert bool((trace.log_evidence[:, 0] < -0.1).all())  # some are away
    torch.testing.assert_close(
        trace.log_evidence[:, 1:], torch.zeros_like(trace.log_evidence[:, 1:]), atol=0.3, rtol=0
    )
    assert bool(trace.belief.best.isfinite().all())


def test_annealed_weights_are_the_last_scores_alone() -> None:
    trace = build(
        AdaptiveResampling(Systematic(), 0.3), reweight=CurrentLikelihood(), estimate=Argmax()
    )(None, Hill(GOALS), Generator().manual_seed(0))
    torch.testing.assert_close(
        trace.particles[-1].log_weights, trace.outputs[-1].log_likelihood.log_softmax(1)
    )
    torch.testing.assert_close(trace.belief.score, trace.outputs[-1].log_likelihood.amax(1))
    assert torch.equal(trace.belief.log_weights, trace.particles[-1].log_weights)
    assert torch.equal(trace.belief.poses, trace.outputs[-1].pose)


def test_copies_of_a_particle_stay_together_until_noise_parts_them() -> None:
    """A deterministic displacement sends all copies of a particle to one place: what resampling
    doubles is one opinion.
    """
    ends = {}
    for name, pieces in (
        ("alone", [LearnedDisplacement()]),
        ("with noise", [LearnedDisplacement(), Gaussian(1.0)]),
    ):
        run = build(
            propagate=Compose(pieces), reweight=CurrentLikelihood(), schedule=Geometric(6.0, 1.5)
        )
        trace = run(None, Hill(GOALS, pull=0.3), Generator().manual_seed(0))
        ends[name] = distinct(trace.particles[-1].state)
    assert (ends["alone"] < 0.5).all()
    assert (ends["with noise"] > 0.9).all()


@pytest.mark.parametrize("rows", [1, 2, 3])
@pytest.mark.parametrize("layout", ["whole rows", "one for all", "every second", "with gradient"])
def test_a_child_has_what_its_ancestor_has_however_it_lies_in_memory(
    rows: int, layout: str
) -> None:
    g = Generator().manual_seed(0)
    values = torch.randn(rows, 5, 2, 3, generator=g)
    if layout == "one for all":
        values = values[:, :1].expand(rows, 5, 2, 3)
    elif layout == "every second":
        values = torch.randn(rows, 10, 2, 3, generator=g)[:, ::2]
    elif layout == "with gradient":
        values = values.requires_grad_()
    ancestors = torch.randint(5, (rows, 7), generator=g)
    found = inherit(values, Resampled(ancestors, torch.zeros(rows, 7)))
    for row in range(rows):
        for child in range(7):
            assert torch.equal(found[row, child], values[row, ancestors[row, child]])


def test_auxiliary_resampling_knows_the_images_of_its_run() -> None:
    """The upper half of the image is relevant: from the second step on most particles are there,
    and weights make up for it.
    """

    class Seen(Hill):
        objectness = torch.ones(1, 1, 2, 1)
        objectness[:, :, 1] = 0.1

        def encode(self, batch: object) -> "Seen":  # type: ignore[override]
            return self

        def measure(
            self, encoding: object, particles: Particles, step: Step, generator: Generator
        ) -> ParticleOutput:
            flat = super().measure(torch.zeros(1, 2), particles, step, generator)
            return flat._replace(log_likelihood=torch.zeros_like(flat.log_likelihood))

    def spread(batch: object, encoding: object, method: Hill, count: int, g: Generator) -> Tensor:
        return torch.rand(1, count, 2, generator=g) * torch.tensor([30.0, 20.0]) - 0.5

    batch = SimpleNamespace(rgb=torch.zeros(1, 3, 20, 30))
    run = build(AuxiliaryResampling(Systematic()), 2000, initialize=spread, propagate=Identity())
    trace = run(batch, Seen(torch.zeros(1, 2)), Generator().manual_seed(0))  # type: ignore[arg-type]
    upper = trace.particles[1].state[0, :, 1] < 9.5
    assert float(upper.double().mean()) == pytest.approx(10 / 11, abs=0.02)
    weight = trace.particles[1].log_weights[0].exp()
    assert float(weight[upper].sum()) == pytest.approx(0.5, abs=0.08)
