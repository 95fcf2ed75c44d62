"""The quadratic fit: exact on what is quadratic, and steady where scores are noisy or flat."""

import torch
from tests.tracking.toy import SPACE, ToyEncoding, make_toy, walk_pose

from posefilter.filters.refine import MeanShift
from posefilter.protocols import Refine
from posefilter.tracking.fit import QuadraticFit, draw_orthogonal, find_maximum, regress
from posefilter.types import BeliefBatch


def quadratic(x: torch.Tensor, peak: torch.Tensor, curvature: torch.Tensor) -> torch.Tensor:
    return 3 - 0.5 * ((x - peak).square() * curvature).sum(-1)


def test_the_maximum_of_a_quadratic_is_found_at_once() -> None:
    g = torch.Generator().manual_seed(0)
    noise = torch.randn(2, 24, 6, generator=g, dtype=torch.float64)
    peak = torch.rand(2, 1, 6, generator=g, dtype=torch.float64) - 0.5
    curvature = 1 + 4 * torch.rand(2, 1, 6, generator=g, dtype=torch.float64)
    up, down = (quadratic(x, peak, curvature) for x in (noise, -noise))
    assert torch.allclose(find_maximum(noise, up, down, 1e6), peak[:, 0], atol=1e-3)
    # a prior about 0 is one more quadratic
    pulled = (curvature * peak / (curvature + 0.25))[:, 0]
    assert torch.allclose(find_maximum(noise, up, down, 2.0), pulled, atol=1e-3)


def test_what_is_flat_or_open_to_above_moves_nothing_far() -> None:
    noise = torch.randn(1, 24, 6, generator=torch.Generator().manual_seed(1))
    flat = torch.full((1, 24), -7.0)
    assert find_maximum(noise, flat, flat, 2.0).abs().max() < 1e-4
    bowl = 5 * noise.square().sum(-1)
    slope = 100 * noise[..., 0]
    step = find_maximum(noise, bowl + slope, bowl - slope, 2.0)
    assert torch.isfinite(step).all()
    assert step.abs().max() <= 1.5


def spread_of(refine: Refine, seeds: int = 12) -> float:
    """Return the root mean square error of a refinement of the toy's noisy scores [m]."""
    toy, _ = make_toy()
    toy.truth = truth = walk_pose(1)[0]
    errors = []
    for seed in range(seeds):
        g = torch.Generator().manual_seed(seed)
        start = SPACE.move(
            truth[None], 0.004 * SPACE.noise_scale(torch.ones(1)) * torch.randn(6, generator=g)
        )
        belief = BeliefBatch(start[:, None], torch.zeros(1, 1), start, torch.zeros(1))
        encoding = ToyEncoding(truth, torch.zeros(1))
        errors.append(SPACE.distance(refine(belief, encoding, toy, g).best, truth[None]))
    return float(torch.stack(errors).square().mean().sqrt())


def test_of_as_many_noisy_scores_it_makes_more_than_a_weighted_mean() -> None:
    fit = spread_of(QuadraticFit(pairs=24))
    mean = spread_of(MeanShift(1, 24, 0.006, 0.006))
    assert fit < 0.006
    assert fit < 0.8 * mean


def test_perturbations_are_normal_and_at_right_angles_in_groups() -> None:
    like = torch.zeros(4000, 1)
    drawn = draw_orthogonal(like, 16, 6, torch.Generator().manual_seed(2))
    assert drawn.shape == (4000, 16, 6)
    for group in (drawn[:, :6], drawn[:, 6:12], drawn[:, 12:]):
        product = group @ group.mT
        size = product.diagonal(dim1=1, dim2=2)
        product = product / (size[:, None] * size[..., None]).sqrt()
        assert (product - torch.eye(group.shape[1])).abs().max() < 1e-4
    # standard errors of one element: 0.016 of a mean, 0.011 of a deviation, 0.022 of a square
    assert drawn.mean(0).abs().max() < 0.07
    assert (drawn.std(0) - 1).abs().max() < 0.05
    assert (drawn.square().sum(-1).mean(0) - 6).abs().max() < 0.25
    assert (drawn.square().sum(-1).std(0) - 12**0.5).abs().max() < 0.35


def test_slopes_are_surer_than_from_as_many_independent_perturbations() -> None:
    g = torch.Generator().manual_seed(3)
    like = torch.zeros(500, 1)
    scores = torch.randn(500, 16, generator=g)  # noise alone, so that the slopes should be 0
    errors = [
        regress(noise, scores).square().mean()
        for noise in (draw_orthogonal(like, 16, 6, g), torch.randn(500, 16, 6, generator=g))
    ]
    assert errors[0] < 0.8 * errors[1]
