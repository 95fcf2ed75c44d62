"""The agreed pose against a truth that most particles know, each a little wrong."""

import math

import pytest
import torch

from posefilter.filters.agreement import Agreement
from posefilter.geometry.pose import fit_rigid, invert, make_pose, transform
from posefilter.geometry.rotation import angle_between, exp_so3, random_rotation
from posefilter.types import BeliefBatch, Fragments, ObjectModel, ParticleOutput, Particles

MODEL = ObjectModel(
    "cube",
    torch.zeros(1, 3),
    torch.tensor([0.0, 0.0, 0.01]),
    0.18,
    0.3,
    torch.eye(4)[None],
    torch.zeros(1, 3),
)


class Points:
    def __init__(self, point: torch.Tensor) -> None:
        self.point, self.object_model = point, MODEL

    def surface_points(
        self, encoding: None, state: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        return self.point, torch.ones_like(self.point[..., 0], dtype=torch.bool)


def test_agreement_beats_the_best_particle_and_shrugs_off_a_third_of_outliers() -> None:
    g = torch.Generator().manual_seed(0)
    B, N = 6, 120
    R, t = (
        random_rotation(B, generator=g),
        torch.rand(B, 3, generator=g) * 0.2 + torch.tensor([0.0, 0.0, 0.8]),
    )
    thing = torch.rand(B, N, 3, generator=g) * 0.2 - 0.1
    point = thing @ R.transpose(-1, -2) + t[:, None]
    told = thing + 0.01 * torch.randn(B, N, 3, generator=g)
    wrong = torch.rand(B, N, generator=g) < 0.33
    told = torch.where(wrong[..., None], torch.rand(B, N, 3, generator=g) * 0.2 - 0.1, told)
    Rs = R[:, None] @ exp_so3(0.15 * torch.randn(B, N, 3, generator=g))
    pose = make_pose(Rs, point - (Rs @ told[..., None])[..., 0])
    log_p = torch.full((B, N), -0.1)
    empty = torch.zeros(B, N, 0)
    particles = Particles(
        torch.zeros(B, N, 2), empty, log_p.log_softmax(1), torch.arange(N).expand(B, N)
    )
    output = ParticleOutput(log_p, torch.zeros(B, N, 2), pose, empty)
    belief = Agreement(scale_m=0.015)(particles, output, None, Points(point), g)  # type: ignore[arg-type]
    assert angle_between(belief.best[:, :3, :3], R).max() < 0.05
    assert (belief.best[:, :3, 3] - t).norm(dim=-1).max() < 0.006
    single = angle_between(pose[:, :, :3, :3], R[:, None]).median()
    assert angle_between(belief.best[:, :3, :3], R).median() < single / 4
    torch.testing.assert_close(belief.log_weights.logsumexp(1), torch.zeros(B), atol=1e-5, rtol=0)
    assert ((belief.score > 0.4) & (belief.score < 0.8)).all()  # about two thirds agree


@pytest.mark.parametrize("constant", [-100.0, -40.0, 60.0, 100.0])
def test_a_constant_of_the_image_changes_no_pose(constant: float) -> None:
    g = torch.Generator().manual_seed(0)
    thing = torch.rand(1, 300, 3, generator=g) * 0.2 - 0.1
    right = torch.rand(1, 300, generator=g) < 0.25  # few, and likely
    truth, other = (
        make_pose(exp_so3(torch.tensor([x, 0.2, 0.1])), torch.tensor([x, 0.0, 1.0]))
        for x in (0.1, -0.3)
    )
    point = torch.where(right[..., None], transform(truth, thing), transform(other, thing))
    pose = torch.where(right[..., None, None], truth, other)
    log_p = torch.where(right, -1.0, -6.0) + constant
    empty = torch.zeros(1, 300, 0)
    particles = Particles(
        torch.zeros(1, 300, 2), empty, log_p.log_softmax(1), torch.arange(300)[None]
    )
    output = ParticleOutput(log_p, torch.zeros(1, 300, 2), pose, empty)
    belief = Agreement()(particles, output, None, Points(point), g)  # type: ignore[arg-type]
    torch.testing.assert_close(belief.best[0], truth, atol=1e-3, rtol=0)


def test_particles_that_cannot_tell_two_sides_apart_agree_on_the_one_that_fits_all() -> None:
    """Six in ten hold the point's mirror image likelier than the point; no particle's own pose is
    near the truth.
    """
    g = torch.Generator().manual_seed(1)
    B, N, K = 6, 120, 4
    R, t = (
        random_rotation(B, generator=g),
        torch.rand(B, 3, generator=g) * 0.2 + torch.tensor([0.0, 0.0, 0.8]),
    )
    thing = torch.rand(B, N, 3, generator=g) * 0.2 - 0.1
    point = thing @ R.transpose(-1, -2) + t[:, None]
    place = torch.rand(B, N, K, 3, generator=g) * 2 - 1
    told = ((thing - MODEL.center) / MODEL.radius)[:, :, None] + 0.02 * torch.randn(
        B, N, 2, 3, generator=g
    )
    place[:, :, :2] = told * torch.tensor([[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]])
    fooled = torch.rand(B, N, generator=g) < 0.6
    share = torch.where(
        fooled[..., None],
        torch.tensor([0.35, 0.45, 0.1, 0.1]),
        torch.tensor([0.45, 0.35, 0.1, 0.1]),
    )
    log_p, empty = torch.full((B, N), -0.1), torch.zeros(B, N, 0)
    particles = Particles(
        torch.zeros(B, N, 2), empty, log_p.log_softmax(1), torch.arange(N).expand(B, N)
    )
    own = make_pose(random_rotation(B, N, generator=g), point)
    said = Fragments(share.log(), place, torch.zeros(B, K, 3), torch.tensor(0.1))
    output = ParticleOutput(log_p, torch.zeros(B, N, 2), own, empty, said)
    belief = Agreement(hypotheses=128)(particles, output, None, Points(point), g)  # type: ignore[arg-type]
    assert angle_between(belief.best[:, :3, :3], R).max() < 0.03
    assert (belief.best[:, :3, 3] - t).norm(dim=-1).max() < 0.004
    near = angle_between(belief.poses[..., :3, :3], R[:, None]) < 0.3
    share_near, mass_near = near.float().mean(), (near * belief.log_weights.exp()).sum(1).mean()
    assert share_near > 0.05, "votes find the truth now and then"
    assert mass_near > share_near, "and count for more there"
    torch.testing.assert_close(belief.log_weights.logsumexp(1), torch.zeros(B), atol=1e-5, rtol=0)


def test_points_that_are_not_known_do_not_count() -> None:
    """Two thirds stand on no measured point, and are certain of another pose."""
    g = torch.Generator().manual_seed(2)
    N = 90
    truth = make_pose(random_rotation(1, generator=g), torch.tensor([[0.1, 0.0, 0.9]]))
    other = make_pose(random_rotation(1, generator=g), torch.tensor([[0.1, 0.1, 0.9]]))
    thing = torch.rand(1, N, 3, generator=g) * 0.2 - 0.1
    known = torch.arange(N)[None] % 3 == 0
    poses = torch.where(known[..., None, None], truth[:, None], other[:, None])
    point = (poses[..., :3, :3] @ thing[..., None])[..., 0] + poses[..., :3, 3]

    class Some(Points):
        def surface_points(
            self, encoding: None, state: torch.Tensor
        ) -> tuple[torch.Tensor, torch.Tensor]:
            return self.point, known

    log_p = torch.where(known, -0.7, -0.01)
    empty = torch.zeros(1, N, 0)
    particles = Particles(
        torch.zeros(1, N, 2), empty, log_p.log_softmax(1), torch.arange(N).expand(1, N)
    )
    output = ParticleOutput(log_p, torch.zeros(1, N, 2), poses, empty)
    belief = Agreement()(particles, output, None, Some(point), g)  # type: ignore[arg-type]
    assert float(angle_between(belief.best[:, :3, :3], truth[:, :3, :3])) < 1e-2
    # all that is known agrees, and the highest likelihood is that of the others
    assert float(belief.score) == pytest.approx(math.exp(-0.01), rel=1e-4)


def test_as_many_fragments_are_considered_as_there_are() -> None:
    log_prob = torch.tensor([[[0.2, 0.5, 0.3]]]).log()
    position = torch.arange(9.0).view(1, 1, 3, 3)
    said = Fragments(log_prob, position, torch.zeros(1, 3, 3), torch.tensor(0.1))
    empty = torch.zeros(1, 1, 0)
    output = ParticleOutput(
        torch.zeros(1, 1), torch.zeros(1, 1, 2), torch.eye(4)[None, None], empty, said
    )
    for options, rows in ((1, [1]), (2, [1, 2]), (9, [1, 2, 0])):
        share, found = Agreement(top_fragments=options).list_object_points(
            output, torch.zeros(1, 1, 3), torch.zeros(3), 1.0
        )
        torch.testing.assert_close(share[0, 0], log_prob[0, 0, rows].exp())
        assert torch.equal(found[0, 0], position[0, 0, rows])


def test_a_particle_agrees_within_two_scales() -> None:
    """Of sixty, three are off by 1.9 scales and three by 2.1: these alone do not agree."""
    g = torch.Generator().manual_seed(4)
    N, scale = 60, 0.01
    truth = make_pose(random_rotation(1, generator=g), torch.tensor([[0.1, 0.0, 0.9]]))
    thing = torch.rand(1, N, 3, generator=g) * 0.2 - 0.1
    own = truth[:, None].repeat(1, N, 1, 1)
    point = (own[..., :3, :3] @ thing[..., None])[..., 0] + own[..., :3, 3]
    # in turn to either side, so that the fit of all is not drawn to one
    side = torch.tensor([1.9, 2.1, -1.9, -2.1, 1.9, -2.1])
    own[0, :6, 0, 3] += scale * side
    log_p, empty = torch.full((1, N), -0.5), torch.zeros(1, N, 0)
    particles = Particles(
        torch.zeros(1, N, 2), empty, log_p.log_softmax(1), torch.arange(N).expand(1, N)
    )
    output = ParticleOutput(log_p, torch.zeros(1, N, 2), own, empty)
    belief = Agreement(scale)(particles, output, None, Points(point), g)  # type: ignore[arg-type]
    assert float(belief.score) == pytest.approx(57 / 60 * math.exp(-0.5), rel=1e-4)


def noisy(count: int = 40, off: float = 0.012) -> tuple[torch.Tensor, ParticleOutput, Particles]:
    """Return measured points, and particles whose poses are each some way off; one image."""
    g = torch.Generator().manual_seed(5)
    truth = make_pose(random_rotation(1, generator=g), torch.tensor([[0.1, 0.0, 0.9]]))
    thing = torch.rand(1, count, 3, generator=g) * 0.2 - 0.1
    point = (truth[:, None, :3, :3] @ thing[..., None])[..., 0] + truth[:, None, :3, 3]
    own = truth[:, None].repeat(1, count, 1, 1)
    own[..., :3, 3] += off * torch.randn(1, count, 3, generator=g)
    log_p, empty = -torch.rand(1, count, generator=g), torch.zeros(1, count, 0)
    particles = Particles(
        torch.zeros(1, count, 2), empty, log_p.log_softmax(1), torch.arange(count)[None]
    )
    return point, ParticleOutput(log_p, torch.zeros(1, count, 2), own, empty), particles


def agree(count: int = 40, **settings: float) -> BeliefBatch:
    point, output, particles = noisy(count)
    g = torch.Generator().manual_seed(6)
    return Agreement(**settings)(particles, output, None, Points(point), g)  # type: ignore[arg-type]


def weigh(pose: torch.Tensor, scale: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return each particle's own object point, its measured one, and its weight under a pose."""
    point, output, _ = noisy()
    told = transform(invert(output.pose), point[:, :, None])[:, :, 0]
    square = (transform(pose, told) - point).square().sum(-1)
    return told, point, output.log_likelihood.exp() / (1 + square / scale**2) ** 2


@pytest.mark.parametrize(("iterations", "scales"), [(1, [4]), (2, [4, 1]), (3, [4, 2, 1])])
def test_the_scale_of_the_refit_falls_from_four_to_one(iterations: int, scales: list[int]) -> None:
    best = agree(iterations=0, scale_m=0.01).best
    for scale in scales:
        best = fit_rigid(*weigh(best, 0.01 * scale))
    found = agree(iterations=iterations, scale_m=0.01).best
    torch.testing.assert_close(found, best, atol=1e-5, rtol=0)


def test_a_vote_counts_by_its_inliers_to_the_power_of_the_counts() -> None:
    belief = agree(scale_m=0.01, effective_particles=3.0)
    inliers = torch.stack([weigh(pose[None], 0.02)[2].sum() for pose in belief.poses[0]])
    torch.testing.assert_close(
        belief.log_weights[0], (3 * inliers.log()).log_softmax(0), atol=1e-3, rtol=0
    )
    assert float(belief.log_weights.std()) > 0.1


def test_where_no_point_is_known_all_count() -> None:
    point, output, particles = noisy()

    class Unknown(Points):
        def surface_points(
            self, encoding: None, state: torch.Tensor
        ) -> tuple[torch.Tensor, torch.Tensor]:
            return self.point, torch.zeros_like(self.point[..., 0], dtype=torch.bool)

    g = torch.Generator().manual_seed(6)
    found = Agreement()(particles, output, None, Unknown(point), g)  # type: ignore[arg-type]
    middle = output.pose[0, :, :3, 3].mean(0)
    assert float((found.best[0, :3, 3] - middle).norm()) < 0.01
    assert 0.5 < float(found.score) <= 1
