"""A belief falls into the hypotheses that it was drawn from, with their shares of the weight."""

import pytest
import torch

from posefilter.filters.modes import find_modes
from posefilter.geometry.pose import move_about
from posefilter.geometry.spaces import PixelSpace, PoseSpace

SPACE = PoseSpace((0.0, 0.0, 0.1), 0.15)


def spread_about(pose: torch.Tensor, count: int, size: float, seed: int) -> torch.Tensor:
    noise = torch.randn(
        count, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    return move_about(
        pose,
        noise * SPACE.noise_scale(torch.tensor(size, dtype=torch.float64)),
        torch.tensor([0, 0, 0.1]).double(),
    )


def hypotheses() -> torch.Tensor:
    """Three poses: one, the same turned upside down, the same 20 cm aside."""
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    poses[:, 2, 3] = 1.0
    poses[1, 1, 1] = poses[1, 2, 2] = -1
    poses[2, 0, 3] = 0.2
    return poses


def test_each_hypothesis_is_a_mode_with_its_share() -> None:
    at, shares, counts = hypotheses(), [0.2, 0.7, 0.1], [150, 60, 90]
    state = torch.cat(
        [
            spread_about(pose, n, 0.003, i)
            for i, (pose, n) in enumerate(zip(at, counts, strict=True))
        ]
    )
    weights = torch.cat(
        [torch.full((n,), share / n) for share, n in zip(shares, counts, strict=True)]
    )
    shuffle = torch.randperm(300, generator=torch.Generator().manual_seed(5))
    modes = find_modes(state[shuffle], weights[shuffle].log(), SPACE, 0.008)
    assert modes.weights.tolist() == pytest.approx([0.7, 0.2, 0.1], abs=1e-6)
    assert (SPACE.distance(modes.states, at[[1, 0, 2]]) < 0.008).all()
    came_from = torch.repeat_interleave(torch.tensor([1, 0, 2]), torch.tensor(counts))
    assert torch.equal(modes.member, came_from[shuffle])


def test_modes_are_particles_and_share_out_all_the_weight() -> None:
    state = torch.rand(200, 2, generator=torch.Generator().manual_seed(0)) * 100
    log_weights = torch.randn(200, generator=torch.Generator().manual_seed(1))
    modes = find_modes(state, log_weights, PixelSpace(), 4.0, max_distance=2.0)
    assert 1 < len(modes.weights) < 200
    assert float(modes.weights.sum()) == pytest.approx(1)
    assert (modes.weights.diff() <= 0).all()
    weights = torch.softmax(log_weights.double(), 0)
    for i, (mode, mass) in enumerate(zip(modes.states, modes.weights, strict=True)):
        mine = modes.member == i
        assert float(weights[mine].sum()) == pytest.approx(float(mass))
        assert (state[mine] == mode).all(1).any()


def test_reach_decides_what_is_one() -> None:
    state = torch.tensor([[0.0, 0.0], [1.0, 0.0], [9.0, 0.0], [10.0, 0.0]])
    log_weights = torch.tensor([0.4, 0.1, 0.2, 0.3]).log()
    near, far = (find_modes(state, log_weights, PixelSpace(), 2.0, reach) for reach in (3.0, 5.0))
    assert near.weights.tolist() == pytest.approx([0.5, 0.5])
    assert near.member[0] == near.member[1] != near.member[2] == near.member[3]
    assert far.weights.tolist() == pytest.approx([1.0])
    assert far.states.tolist() == [[0.0, 0.0]]


def test_copies_of_one_pose_are_one_mode() -> None:
    state = torch.eye(4).repeat(50, 1, 1)
    modes = find_modes(state, torch.zeros(50), SPACE, 0.005)
    assert modes.weights.tolist() == pytest.approx([1.0])
    assert (modes.member == 0).all()


def test_a_particle_without_weight_is_harmless() -> None:
    state = torch.tensor([[0.0, 0.0], [50.0, 0.0]])
    modes = find_modes(state, torch.tensor([0.0, -torch.inf]), PixelSpace(), 1.0)
    assert modes.weights.tolist() == [1.0, 0.0]
    assert modes.states[0].tolist() == [0.0, 0.0]
