"""Schedules, proposals and estimates, one by one."""

import math

import pytest
import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.filters.estimate import Argmax, DensestMode, DensestPose, Mean, kernel_mass
from posefilter.filters.propagate import (
    AxisRotations,
    Compose,
    Gaussian,
    HalfTurnRotations,
    Identity,
    LearnedDisplacement,
)
from posefilter.filters.schedule import Constant, Geometric
from posefilter.geometry.pose import is_rigid, make_pose, origin_of, rotation_of
from posefilter.geometry.rotation import angle_between, exp_so3, random_rotation
from posefilter.geometry.spaces import PixelSpace, PoseSpace
from posefilter.types import ParticleOutput, Particles, Step

PIXELS = PixelSpace()
POSES = PoseSpace((0.02, 0.0, -0.03), 0.1)
CENTER = torch.tensor(POSES.center)


def step(sigma: float | list[float]) -> Step:
    return Step(1, 5, torch.tensor(sigma))


def some_poses(*shape: int, seed: int = 0) -> Tensor:
    g = Generator().manual_seed(seed)
    return make_pose(random_rotation(*shape, generator=g), torch.randn(*shape, 3, generator=g))


def test_schedules() -> None:
    assert Constant(3.0)(4) == [3.0] * 4
    assert Geometric(8.0, 1.0)(4) == pytest.approx([8, 4, 2, 1])
    assert Geometric(8.0, 1.0)(1) == [1.0]
    with pytest.raises(UserError, match="initial_sigma"):
        Geometric(0.0, 1.0)


def test_gaussian_moves_have_the_size_of_the_noise_level() -> None:
    g = Generator().manual_seed(0)
    moved = Gaussian(0.5)(
        torch.zeros(2, 20000, 2), torch.zeros(2, 20000, 2), step([2.0, 6.0]), PIXELS, g
    )
    torch.testing.assert_close(
        moved.std(1), torch.tensor([[1.0, 1.0], [3.0, 3.0]]), rtol=0.03, atol=0
    )
    poses = some_poses(1, 1).expand(1, 8000, 4, 4)
    moved = Gaussian(0.5)(poses, torch.zeros(1, 8000, 6), step(0.04), POSES, g)
    shift = origin_of(moved, CENTER) - origin_of(poses, CENTER)
    torch.testing.assert_close(shift.std(1), torch.full((1, 3), 0.02), rtol=0.05, atol=0)
    turn = angle_between(rotation_of(moved), rotation_of(poses)).square().mean().sqrt()
    assert float(turn) == pytest.approx(0.2 * 3**0.5, rel=0.05)


def test_learned_displacement_and_chains() -> None:
    state, displacement, g = (
        torch.zeros(1, 3, 2),
        torch.tensor([[[1.0, 2.0]] * 3]),
        Generator().manual_seed(0),
    )
    assert torch.equal(
        LearnedDisplacement()(state, displacement, step(1.0), PIXELS, g), displacement
    )
    assert torch.equal(Identity()(state, displacement, step(1.0), PIXELS, g), state)
    assert torch.equal(
        Compose([LearnedDisplacement(), LearnedDisplacement()])(
            state, displacement, step(1.0), PIXELS, g
        ),
        2 * displacement,
    )
    again = Generator().manual_seed(0)
    noisy = Compose([LearnedDisplacement(), Gaussian(1.0)])(
        state, displacement, step(1.0), PIXELS, g
    )
    torch.testing.assert_close(
        noisy, displacement + Gaussian(1.0)(state, displacement, step(1.0), PIXELS, again)
    )


def test_half_turns_turn_a_share_about_the_center() -> None:
    poses = some_poses(2, 5000)
    moved = HalfTurnRotations(0.3)(
        poses, torch.zeros(2, 5000, 6), step(0.1), POSES, Generator().manual_seed(0)
    )
    assert is_rigid(moved, 1e-4)
    torch.testing.assert_close(
        origin_of(moved, CENTER), origin_of(poses, CENTER), atol=1e-5, rtol=0
    )
    angle = angle_between(rotation_of(moved), rotation_of(poses))
    turned = angle > 1
    assert float(turned.float().mean()) == pytest.approx(0.3, abs=0.02)
    torch.testing.assert_close(
        angle[turned], torch.full_like(angle[turned], math.pi), atol=2e-3, rtol=0
    )
    assert angle[~turned].max() < 2e-3
    relative = (
        (rotation_of(poses).mT @ rotation_of(moved))[turned].diagonal(dim1=-2, dim2=-1).round()
    )
    kinds, counts = relative.unique(dim=0, return_counts=True)
    assert len(kinds) == 3  # one axis keeps its sign
    assert counts.min() > 0.28 * counts.sum()


def test_axis_turns_are_about_the_axes_of_the_box() -> None:
    askew = torch.tensor([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])  # axes in rows
    corners = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5])] * 3) * torch.tensor([0.1, 0.2, 0.3])
    space = PoseSpace(POSES.center, POSES.radius, points=corners @ askew)
    poses = some_poses(2, 4000)
    still = torch.zeros(2, 4000, 6)

    def turn(share: float, any_angle: float) -> tuple[torch.Tensor, torch.Tensor]:
        kernel = AxisRotations(share, any_angle)
        moved = kernel(poses, still, step(0.1), space, Generator().manual_seed(0))
        assert is_rigid(moved, 1e-4)
        torch.testing.assert_close(
            origin_of(moved, CENTER), origin_of(poses, CENTER), atol=1e-5, rtol=0
        )
        relative = rotation_of(poses).mT @ rotation_of(moved)
        return relative, angle_between(rotation_of(moved), rotation_of(poses))

    relative, angle = turn(0.3, 0.0)
    turned = angle > 1
    assert float(turned.float().mean()) == pytest.approx(0.3, abs=0.02)
    torch.testing.assert_close(
        angle[turned], torch.full_like(angle[turned], math.pi), atol=2e-3, rtol=0
    )
    # in the frame of the box, a half turn about an axis flips the signs of the other two
    signs = (askew @ relative[turned] @ askew.T).round().abs()
    torch.testing.assert_close(signs, torch.eye(3).expand_as(signs))
    _, angle = turn(1.0, 1.0)  # angles are uniform
    assert angle.mean() == pytest.approx(math.pi / 2, abs=0.03)


class Poses:
    space = POSES


class Pixels:
    space = PIXELS


def two_clusters() -> tuple[Particles, ParticleOutput]:
    """One image: a tight cluster of three light particles, and a lone one with the most weight and
    likelihood.
    """
    base = some_poses(2, 1).expand(2, 4, 4, 4).clone()
    base[:, 3] = some_poses(2, 1, seed=5)[:, 0]
    base = POSES.move(base, 0.001 * torch.randn(2, 4, 6, generator=Generator().manual_seed(1)))
    weights = torch.tensor([[0.25, 0.2, 0.15, 0.4]] * 2)
    particles = Particles(base, torch.zeros(2, 4, 0), weights.log(), torch.arange(4).expand(2, 4))
    return particles, ParticleOutput(
        torch.tensor([[1.0, 2.0, 3.0, 4.0]] * 2), torch.zeros(2, 4, 6), base, particles.latent
    )


def test_best_and_densest_differ_where_they_should() -> None:
    particles, output = two_clusters()
    best = Argmax()(particles, output, None, Poses(), Generator())
    assert torch.equal(best.best, particles.state[:, 3])
    assert best.score.tolist() == [4.0, 4.0]
    for estimate in (DensestMode(0.01), DensestPose(0.01, 0.1)):
        belief = estimate(particles, output, None, Poses(), Generator())
        assert (POSES.distance(belief.best, particles.state[:, 0]) < 0.01).all()
        torch.testing.assert_close(belief.score.exp(), torch.tensor([0.6, 0.6]), atol=0.05, rtol=0)
        assert torch.equal(belief.poses, particles.state)
        assert torch.equal(belief.log_weights, particles.log_weights)


def test_pixels_agree_in_the_image_or_on_a_pose() -> None:
    particles, output = two_clusters()
    # the heavy one has company here
    pixels = torch.tensor([[[0.0, 0.0], [50, 0], [100, 0], [101, 0]]] * 2)
    particles = particles._replace(state=pixels)
    assert torch.equal(
        DensestMode(3.0)(particles, output, None, Pixels(), Generator()).best, output.pose[:, 3]
    )
    vote = DensestPose(0.01, 0.1)(particles, output, None, Pixels(), Generator())
    assert (POSES.distance(vote.best, output.pose[:, 0]) < 0.01).all()


def test_poses_are_compared_as_predicted_where_a_state_holds_less() -> None:
    """As of `RotationGrid`, whose states have rotations that mean nothing."""
    particles, output = two_clusters()
    noise = torch.zeros(2, 4, 6)
    noise[..., 3:] = torch.randn(2, 4, 3, generator=Generator().manual_seed(2))
    unread = particles._replace(state=POSES.move(particles.state, noise))
    known, found = (
        DensestMode(0.01)(one, output, None, Poses(), Generator()) for one in (particles, unread)
    )
    assert torch.equal(found.best, known.best)
    assert torch.equal(found.score, known.score)


@pytest.mark.parametrize("chunk", [1 << 20, 20])
def test_kernel_mass_is_a_double_loop(chunk: int) -> None:
    g = Generator().manual_seed(0)
    state, log_w = torch.randn(2, 7, 2, generator=g), torch.randn(2, 7, generator=g).log_softmax(1)
    found = kernel_mass(state, log_w, PIXELS, 0.8, chunk)
    for b in range(2):
        for i in range(7):
            near = [
                math.exp(-0.5 * float((state[b, i] - state[b, j]).norm() / 0.8) ** 2)
                for j in range(7)
            ]
            mass = sum(math.exp(log_w[b, j]) * near[j] for j in range(7))
            assert float(found[b, i].exp()) == pytest.approx(mass, rel=1e-4)


def test_mean_is_the_spaces() -> None:
    particles, output = two_clusters()
    belief = Mean()(particles, output, None, Poses(), Generator())
    torch.testing.assert_close(
        belief.best, POSES.mean(particles.state, particles.log_weights.exp())
    )
    assert belief.score.tolist() == pytest.approx([0.25 + 0.4 + 0.45 + 1.6] * 2)
    assert is_rigid(Mean()(particles, output, None, Pixels(), Generator()).best)


def test_a_mean_of_poses_that_pixels_predict_is_about_the_origin_of_the_object() -> None:
    particles, output = two_clusters()
    found = Mean()(particles, output, None, Pixels(), Generator())
    weights = particles.log_weights.exp()[..., None]
    torch.testing.assert_close(found.best[:, :3, 3], (weights * output.pose[..., :3, 3]).sum(1))


def test_a_turn_counts_as_the_shift_at_the_radius_by_hand() -> None:
    """Two poses at one place, 0.2 rad apart: 20 mm at 0.1 m, one bandwidth of 20 mm."""
    pose = torch.eye(4).repeat(1, 2, 1, 1)
    pose[0, 1, :3, :3] = exp_so3(torch.full((3,), 0.2 / 3**0.5))
    pose[..., :3, 3] = torch.tensor([0.3, -0.2, 1.0])
    weights = torch.tensor([[0.75, 0.25]]).log()
    particles = Particles(pose, torch.zeros(1, 2, 0), weights, torch.arange(2)[None])
    output = ParticleOutput(torch.zeros(1, 2), torch.zeros(1, 2, 6), pose, particles.latent)
    found = DensestPose(0.02)(particles, output, None, Pixels(), Generator())
    assert float(found.score.exp()) == pytest.approx(0.75 + 0.25 * math.exp(-0.5), abs=1e-4)
