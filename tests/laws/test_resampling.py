"""Every resampler keeps the weighted mean and hands out normalized weights."""

import math
from types import SimpleNamespace

import pytest
import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.filters.auxiliary import AuxiliaryResampling
from posefilter.filters.loop import inherit, make_particles
from posefilter.filters.niches import Niches
from posefilter.filters.resample import (
    AdaptiveResampling,
    InverseCDF,
    Islands,
    Multinomial,
    NoResampling,
    Soft,
    Stratified,
    Systematic,
    effective_sample_size,
    inverse_cdf,
)
from posefilter.filters.transport import EnsembleTransform, SampledTransport, sinkhorn
from posefilter.geometry.pose import is_rigid, make_pose
from posefilter.geometry.rotation import random_rotation
from posefilter.geometry.spaces import PixelSpace, PoseSpace
from posefilter.protocols import Resample
from posefilter.types import Particles, Resampled

SPACE = PixelSpace()
RESAMPLERS = {
    "systematic": Systematic(),
    "stratified": Stratified(),
    "multinomial": Multinomial(),
    "soft": Soft(0.5),
    "adaptive": AdaptiveResampling(Systematic(), 0.5),
    "islands": Islands(Systematic(), 8),
    "niches": Niches(8),
    "sampled transport": SampledTransport(),
    "ensemble transform": EnsembleTransform(),
}
every = pytest.mark.parametrize("resampler", RESAMPLERS.values(), ids=RESAMPLERS.keys())


def cloud_of(rows: int, count: int, seed: int = 0, sharpness: float = 1.5) -> Particles:
    g = Generator().manual_seed(seed)
    state = torch.randn(1, count, 2, generator=g).expand(rows, -1, -1)
    log_w = torch.log_softmax(sharpness * torch.randn(1, count, generator=g), 1).expand(rows, -1)
    return make_particles(state, 0)._replace(log_weights=log_w)


def parents_share(resampled: Resampled, count: int) -> Tensor:
    """Return each parent's share of the children's weight, mean over the rows.  -> (M,)."""
    weights = resampled.log_weights.exp()
    if resampled.mixture_weights is not None:
        return (weights[..., None] * resampled.mixture_weights).sum(1).mean(0)
    return torch.zeros(len(weights), count).scatter_add(1, resampled.ancestors, weights).mean(0)


@every
@pytest.mark.parametrize("count", [40, 25, 90])
def test_weights_are_kept_in_expectation(resampler: Resample, count: int) -> None:
    slow = isinstance(resampler, SampledTransport | Niches)
    rows, noise = (200, 0.015) if slow else (4000, 0.004)
    particles = cloud_of(rows, 40)
    resampled = resampler(particles, count, SPACE, Generator().manual_seed(1))
    assert resampled.ancestors.shape == resampled.log_weights.shape == (rows, count)
    assert resampled.ancestors.dtype == torch.int64
    torch.testing.assert_close(
        resampled.log_weights.logsumexp(1), torch.zeros(rows), atol=1e-4, rtol=0
    )
    # Soft divides by the sum of its weights, which is right up to 1 / N.
    slack = 0.3 / count if isinstance(resampler, Soft) else 0.0
    torch.testing.assert_close(
        parents_share(resampled, 40), particles.log_weights[0].exp(), atol=noise + slack, rtol=0.02
    )


def test_the_law_catches_a_resampler_that_ignores_weights() -> None:
    class Blind(InverseCDF):
        def __call__(self, particles: Particles, *rest: object) -> Resampled:
            return super().__call__(
                particles._replace(log_weights=torch.zeros_like(particles.log_weights)), *rest
            )

        def uniforms(
            self, rows: int, count: int, generator: Generator, device: torch.device
        ) -> Tensor:
            return torch.rand(rows, count, generator=generator)

    particles = cloud_of(4000, 40)
    share = parents_share(Blind()(particles, 40, SPACE, Generator().manual_seed(0)), 40)
    assert (share - particles.log_weights[0].exp()).abs().max() > 0.02


@every
def test_the_same_generator_draws_the_same_ancestors(resampler: Resample) -> None:
    particles = cloud_of(3, 30)
    a = resampler(particles, 30, SPACE, Generator().manual_seed(5))
    b = resampler(particles, 30, SPACE, Generator().manual_seed(5))
    assert torch.equal(a.ancestors, b.ancestors)
    assert torch.equal(a.log_weights, b.log_weights)


@pytest.mark.parametrize(
    "scheme", [Systematic(), Stratified(), Multinomial()], ids=lambda x: type(x).__name__
)
def test_inverse_cdf_lookup_equals_a_loop(scheme: InverseCDF) -> None:
    particles = cloud_of(3, 20)
    resampled = scheme(particles, 30, SPACE, Generator().manual_seed(2))
    uniforms = scheme.uniforms(3, 30, Generator().manual_seed(2), torch.device("cpu"))
    for row in range(3):
        for n in range(30):
            left, parent = float(uniforms[row, n]), 0
            while left >= (w := float(particles.log_weights[row, parent].double().exp())):
                left, parent = left - w, parent + 1
            assert resampled.ancestors[row, n] == parent


def test_systematic_rounds_each_share_up_or_down() -> None:
    particles = cloud_of(200, 40)
    ancestors = Systematic()(particles, 100, SPACE, Generator().manual_seed(0)).ancestors
    counts = torch.zeros(200, 40).scatter_add(1, ancestors, torch.ones(200, 100))
    assert ((counts - 100 * particles.log_weights.exp()).abs() < 1).all()


def test_a_particle_of_no_weight_is_no_ancestor() -> None:
    log_w = torch.tensor([[-math.inf, 0.0, -math.inf, -math.inf]])
    for uniforms in (torch.zeros(1, 3), torch.full((1, 3), 1 - 2**-24), torch.rand(1, 3)):
        assert (inverse_cdf(log_w, uniforms) == 1).all()


def test_effective_size_at_both_ends() -> None:
    alike = torch.full((1, 50), -math.log(50))
    single = torch.log(torch.tensor([[1.0] + [0.0] * 49]))
    halves = torch.log(torch.tensor([[0.5, 0.5] + [0.0] * 48]))
    sizes = torch.cat([effective_sample_size(x) for x in (alike, single, halves)])
    torch.testing.assert_close(sizes, torch.tensor([50.0, 1.0, 2.0]))


def test_adaptive_resampling_decides_for_each_image() -> None:
    rich, poor = torch.zeros(1, 20), torch.cat([torch.full((1, 1), 6.0), torch.zeros(1, 19)], 1)
    particles = cloud_of(2, 20)._replace(
        log_weights=torch.log_softmax(torch.cat([rich, poor]) + 0.1 * torch.randn(2, 20), 1)
    )
    for inner in (Systematic(), EnsembleTransform()):
        resampled = AdaptiveResampling(inner, 0.5)(particles, 20, SPACE, Generator().manual_seed(0))
        assert torch.equal(resampled.ancestors[0], torch.arange(20))
        assert torch.equal(resampled.log_weights[0], particles.log_weights[0])
        assert torch.equal(inherit(particles.state, resampled, SPACE)[0], particles.state[0])
        assert effective_sample_size(resampled.log_weights)[1] > 19
        assert effective_sample_size(particles.log_weights)[1] < 10


def test_never_keeps_all_and_refuses_another_size() -> None:
    particles = cloud_of(2, 20)
    resampled = NoResampling()(particles, 20, SPACE, Generator())
    assert torch.equal(resampled.ancestors, torch.arange(20).expand(2, 20))
    assert torch.equal(resampled.log_weights, particles.log_weights)
    with pytest.raises(UserError, match="initial_particles"):
        NoResampling()(particles, 10, SPACE, Generator())


def test_soft_weights_carry_the_gradient_of_the_weighted_mean() -> None:
    particles = cloud_of(1, 400)
    logits = particles.log_weights[:1].clone().requires_grad_()
    log_w = torch.log_softmax(logits, 1)
    (exact,) = torch.autograd.grad(
        (log_w.exp() * particles.state[..., 0]).sum(), logits, retain_graph=True
    )
    total = torch.zeros_like(exact)
    for seed in range(200):
        resampled = Soft(0.5)(
            particles._replace(log_weights=log_w), 400, SPACE, Generator().manual_seed(seed)
        )
        mean = (
            resampled.log_weights.exp() * inherit(particles.state[..., :1], resampled)[..., 0]
        ).sum()
        total += torch.autograd.grad(mean, logits, retain_graph=True)[0] / 200
    assert (total - exact).norm() < 0.1 * exact.norm()


def test_sinkhorn_meets_both_marginals_and_nears_the_exact_plan() -> None:
    g = Generator().manual_seed(0)
    a, b = torch.log_softmax(torch.randn(2, 1, 12, generator=g, dtype=torch.float64), 2)
    x, y = torch.randn(2, 1, 12, 1, generator=g, dtype=torch.float64).sort(2).values
    cost = (x - y.transpose(1, 2)).square()
    plan = sinkhorn(cost, a, b, 0.01, 3000).exp()
    torch.testing.assert_close(plan.sum(2), a.exp(), atol=1e-4, rtol=0)
    torch.testing.assert_close(plan.sum(1), b.exp(), atol=1e-9, rtol=0)
    # On a line the best plan is the sorted one: its cost by merging the two cumulative sums.
    cuts = torch.cat([a.exp().cumsum(1), b.exp().cumsum(1)], 1).sort(1).values.clamp(max=1)
    widths = cuts.diff(prepend=torch.zeros(1, 1, dtype=cuts.dtype))
    middle = cuts - widths / 2
    i = torch.searchsorted(a.exp().cumsum(1), middle).clamp(max=11)
    j = torch.searchsorted(b.exp().cumsum(1), middle).clamp(max=11)
    exact = float((widths * (x[0, i[0], 0] - y[0, j[0], 0]).square()).sum())
    assert exact - 1e-3 <= float((plan * cost).sum()) < exact + 0.03


def test_an_ensemble_keeps_the_mean_exactly_and_passes_gradients() -> None:
    particles = cloud_of(2, 30)
    logits = particles.log_weights.clone().requires_grad_()
    state = particles.state.clone().requires_grad_()
    log_w = torch.log_softmax(logits, 1)
    resampled = EnsembleTransform(0.1, 5)(
        particles._replace(log_weights=log_w, state=state), 30, SPACE, Generator()
    )
    moved = inherit(state, resampled, SPACE)
    before = (log_w.exp()[..., None] * state).sum(1)
    torch.testing.assert_close((resampled.log_weights.exp()[..., None] * moved).sum(1), before)
    moved[..., 0].square().sum().backward()
    assert logits.grad.isfinite().all()
    assert logits.grad.abs().sum() > 1e-3
    assert state.grad.abs().sum() > 1e-3


@pytest.mark.parametrize("space", [SPACE, PoseSpace((0.01, 0.0, 0.02), 0.1)], ids=["px", "poses"])
def test_the_gradient_of_an_ensemble_is_whole(space: PixelSpace | PoseSpace) -> None:
    """By finite differences: the weights shape the plan, and the states by its costs, too."""
    g = Generator().manual_seed(0)
    logits = torch.randn(1, 5, generator=g).double().requires_grad_()
    moves = (0.5 * torch.randn(1, 5, space.dimensions, generator=g).double()).requires_grad_()
    start = torch.zeros(2) if space is SPACE else torch.eye(4)

    def children(logits: Tensor, moves: Tensor) -> Tensor:
        state = space.move(start.double().expand(1, 5, *start.shape), moves)
        particles = make_particles(state, 0)._replace(log_weights=logits.log_softmax(1))
        resampled = EnsembleTransform(0.2, 20)(particles, 5, space, g)
        return torch.cat(
            [inherit(state, resampled, space).flatten(2), resampled.log_weights[..., None]], 2
        )

    assert torch.autograd.gradcheck(children, (logits, moves))


def test_the_ancestor_of_a_mixture_is_its_largest_part() -> None:
    resampled = EnsembleTransform(0.02, 20)(cloud_of(2, 30), 30, SPACE, Generator())
    assert resampled.mixture_weights is not None
    assert torch.equal(resampled.mixture_weights.max(2).indices, resampled.ancestors)
    assert float(resampled.mixture_weights.amax(2).mean()) > 0.3


def test_transport_moves_particles_less_than_a_shuffle() -> None:
    particles = cloud_of(8, 100)
    moved = {}
    for name in ("multinomial", "sampled transport"):
        resampled = RESAMPLERS[name](particles, 100, SPACE, Generator().manual_seed(0))
        moved[name] = (inherit(particles.state, resampled) - particles.state).norm(dim=-1).mean()
    assert moved["sampled transport"] < 0.6 * moved["multinomial"]


@every
def test_poses_stay_poses(resampler: Resample) -> None:
    g = Generator().manual_seed(0)
    poses = make_pose(random_rotation(2, 20, generator=g), torch.randn(2, 20, 3, generator=g))
    particles = make_particles(poses, 3)._replace(
        log_weights=torch.log_softmax(torch.randn(2, 20, generator=g), 1)
    )
    space = PoseSpace((0.01, 0.0, 0.02), 0.1)
    assert is_rigid(inherit(particles.state, resampler(particles, 30, space, g), space), 1e-4)


def test_islands_never_mix() -> None:
    resampled = Islands(Systematic(), 10)(cloud_of(3, 40), 80, SPACE, Generator().manual_seed(2))
    island = torch.arange(80) // 20
    assert torch.equal(resampled.ancestors // 10, island.expand(3, -1))


def test_islands_keep_a_mode_that_one_population_loses() -> None:
    """Two equal modes, the weights noisy: after 120 steps one population has drifted to one."""
    kept = {}
    for name, scheme in (("one", Systematic()), ("islands", Islands(Systematic(), 10))):
        g = Generator().manual_seed(3)
        state = (torch.arange(80) % 2).float()[None, :, None].expand(200, -1, 2)
        for _ in range(120):
            noisy = torch.log_softmax(torch.randn(200, 80, generator=g), 1)
            particles = make_particles(state, 0)._replace(log_weights=noisy)
            state = inherit(state, scheme(particles, 80, SPACE, g), SPACE)
        share = state[..., 0].mean(1)
        kept[name] = float(((share > 0) & (share < 1)).float().mean())
    assert kept["one"] < 0.5
    assert kept["islands"] > 0.9


def test_niches_keep_the_narrow_mode_that_annealing_loses() -> None:
    """A wide mode and a narrow one of equal mass, 20 apart: the narrow one's share of a flat
    likelihood is a fiftieth, and 60 particles are one of it.
    """
    kept = {}
    for name, scheme in (("one", Systematic()), ("niches", Niches(6))):
        g = Generator().manual_seed(5)
        state = torch.randn(100, 60, 2, generator=g) * 2.0
        state[:, 0] = torch.tensor([20.0, 0.3])
        for power in torch.logspace(-2, 0, 12):
            wide = -0.5 * (state / 2.0).square().sum(-1)
            narrow = -0.5 * ((state - torch.tensor([20.0, 0.0])) / 0.2).square().sum(-1)
            log_w = torch.log_softmax(power * torch.logaddexp(wide, narrow), 1)
            particles = make_particles(state, 0)._replace(log_weights=log_w)
            state = inherit(state, scheme(particles, 60, SPACE, g), SPACE)
            state = state + 0.05 * torch.randn(state.shape, generator=g)
        share = (state[..., 0] > 10).float().mean(1)
        kept[name] = float((share > 0).float().mean())
    assert kept["one"] < 0.7
    assert kept["niches"] == 1.0


def test_niches_have_equally_many_children_about_the_peaks() -> None:
    state = torch.tensor([0.0, 0.1, 5.0, 5.1, 9.0, 9.1])[None, :, None].repeat(1, 1, 2)
    log_w = torch.tensor([[0.4, 0.2, 0.2, 0.1, 0.06, 0.04]]).log()
    particles = make_particles(state, 0)._replace(log_weights=log_w)
    new = Niches(3)(particles, 30, SPACE, Generator().manual_seed(0))
    place = state[0, new.ancestors[0], 0].round()
    for where, mass in ((0.0, 0.6), (5.0, 0.3), (9.0, 0.1)):
        assert int((place == where).sum()) == 10
        own = new.log_weights[0, place == where].exp()
        torch.testing.assert_close(own, torch.full((10,), mass / 10))


def test_an_island_is_not_empty() -> None:
    with pytest.raises(UserError, match="size=0"):
        Islands(Systematic(), 0)


def test_a_point_that_rounding_brings_to_one_has_an_ancestor_with_weight() -> None:
    """(n - 1 + u) / n is 1 in single precision for u near 1."""
    log_w = torch.tensor([[-math.inf, 0.0, -math.inf]])
    assert (inverse_cdf(log_w, torch.ones(1, 3)) == 1).all()


def test_transport_of_even_weights_leaves_each_particle_where_it_is() -> None:
    particles = make_particles(torch.randn(2, 12, 2, generator=Generator().manual_seed(0)), 0)
    for scheme in (SampledTransport(0.002, 500), EnsembleTransform(0.002, 500)):
        new = scheme(particles, 12, SPACE, Generator().manual_seed(1))
        assert torch.equal(new.ancestors, torch.arange(12).expand(2, 12))


def test_what_needs_one_ancestor_a_child_refuses_mixtures() -> None:
    particles = cloud_of(2, 20)
    with pytest.raises(UserError, match="needs a scheme that draws ancestors"):
        Islands(EnsembleTransform(), 5)(particles, 20, SPACE, Generator())
    seen = SimpleNamespace(objectness=torch.ones(2, 1, 6, 8))
    draw = AuxiliaryResampling(EnsembleTransform()).bind(seen, 60, 80)
    with pytest.raises(UserError, match="children have one ancestor"):
        draw(particles, 20, SPACE, Generator())
