"""The two spaces: moves, means and distances, against naive ones."""

import math

import pytest
import torch
from torch import Generator

from posefilter.geometry.pose import is_rigid, make_pose, origin_of, rotation_of
from posefilter.geometry.rotation import angle_between, random_rotation
from posefilter.geometry.spaces import PixelSpace, PoseSpace

PIXELS = PixelSpace()
POSES = PoseSpace((0.02, -0.01, 0.03), 0.1)
CENTER = torch.tensor(POSES.center)


def scattered(*shape: int, seed: int = 0) -> torch.Tensor:
    g = Generator().manual_seed(seed)
    return make_pose(random_rotation(*shape, generator=g), torch.randn(*shape, 3, generator=g))


def test_a_move_of_nothing_is_nothing() -> None:
    T = scattered(3, 4)
    torch.testing.assert_close(POSES.move(T, torch.zeros(3, 4, 6)), T, atol=1e-6, rtol=0)
    assert torch.equal(PIXELS.move(torch.ones(5, 2), torch.zeros(5, 2)), torch.ones(5, 2))


def test_a_move_of_sigma_shifts_the_surface_by_sigma_either_way() -> None:
    scale = POSES.noise_scale(torch.tensor(0.02))
    torch.testing.assert_close(scale, torch.tensor([0.02, 0.02, 0.02, 0.2, 0.2, 0.2]))
    assert POSES.noise_scale(torch.tensor([0.02, 0.5])).shape == (2, 6)
    assert POSES.noise_scale(torch.tensor(0.5))[3] == pytest.approx(POSES.max_rotation_std)
    T = scattered(100)
    for axis in range(6):
        tangent = torch.zeros(100, 6)
        tangent[:, axis] = scale[axis]
        torch.testing.assert_close(
            POSES.distance(POSES.move(T, tangent), T), torch.full((100,), 0.02), atol=1e-4, rtol=0
        )


def test_the_mean_of_symmetric_moves_is_the_middle() -> None:
    T = scattered(5)
    tangent = 0.3 * torch.randn(5, 1, 8, 6, generator=Generator().manual_seed(0))
    tangent = torch.cat([tangent, -tangent], 1).flatten(1, 2)
    particles = POSES.move(T[:, None].expand(5, 16, 4, 4), tangent)
    mean = POSES.mean(particles, torch.full((5, 16), 1 / 16))
    assert is_rigid(mean, 1e-4)
    torch.testing.assert_close(mean, T, atol=1e-4, rtol=0)
    lopsided = POSES.mean(particles, torch.softmax(3 * torch.randn(5, 16), 1))
    assert (lopsided - T).abs().max() > 0.01


def test_the_mean_minimizes_the_weighted_squared_chord() -> None:
    particles, w = (
        POSES.move(scattered(1, 1).expand(1, 9, 4, 4), 0.4 * torch.randn(1, 9, 6)),
        torch.softmax(torch.randn(1, 9), 1),
    )
    mean = POSES.mean(particles, w)
    torch.testing.assert_close(
        origin_of(mean, CENTER), (w[..., None] * origin_of(particles, CENTER)).sum(1)
    )

    def cost(T: torch.Tensor) -> torch.Tensor:
        chord = (rotation_of(particles) - rotation_of(T)[:, None]).square().sum((-1, -2))
        return (w * chord).sum()

    for _ in range(20):
        near = POSES.move(mean, torch.cat([torch.zeros(1, 3), 0.05 * torch.randn(1, 3)], -1))
        assert cost(near) > cost(mean)


def test_distances() -> None:
    a, b = scattered(20, seed=1), scattered(20, seed=2)
    shift = (origin_of(a, CENTER) - origin_of(b, CENTER)).norm(dim=-1)
    turn = angle_between(rotation_of(a), rotation_of(b)) * POSES.radius
    for i in range(20):
        assert POSES.distance(a, b)[i] == pytest.approx(
            math.hypot(float(shift[i]), float(turn[i])), rel=1e-5
        )
    assert PIXELS.distance(torch.tensor([3.0, 0.0]), torch.tensor([0.0, 4.0])) == 5.0


def test_noise_on_pixels_is_the_same_along_both_axes() -> None:
    assert PIXELS.noise_scale(torch.tensor([2.0, 3.0])).tolist() == [[2, 2], [3, 3]]
    assert PIXELS.dimensions == 2
