"""The density of weighted poses: it integrates to 1, nears the density that the poses were drawn
from, and knows symmetries.
"""

import math

import pytest
import torch
from torch import Generator, Tensor

from posefilter.geometry.pose import make_pose, move_about
from posefilter.geometry.pose_density import (
    PoseDensity,
    fit_density,
    log_density,
    log_density_held_out,
)
from posefilter.geometry.pose_kernels import pair_twists, split_poses
from posefilter.geometry.pose_statistics import twist_between
from posefilter.geometry.rotation import exp_so3, random_rotation

CENTER = torch.tensor([0.02, -0.01, 0.1]).double()
RADIUS, DIAMETER = 0.12, 0.25
VOLUME = math.pi**2  # of SO(3)


def generator(seed: int = 0) -> Generator:
    return Generator().manual_seed(seed)


def somewhere(seed: int = 0) -> Tensor:
    g = generator(seed)
    return make_pose(random_rotation(generator=g).double(), torch.randn(3, generator=g).double())


def factor() -> Tensor:
    """Return the Cholesky factor of a covariance in which shifts and turns go together."""
    mix = torch.eye(6).double()
    mix[0, 4] = mix[4, 0] = 0.8
    mix[1, 2] = mix[2, 1] = -0.5
    scale = torch.diag(torch.tensor([0.004, 0.002, 0.02, 0.02, 0.2, 0.05]).double())
    return torch.linalg.cholesky(scale @ mix @ scale)


def draw(count: int, g: Generator) -> Tensor:
    noise = torch.randn(count, 6, generator=g, dtype=torch.float64)
    return move_about(somewhere().expand(count, 4, 4), noise @ factor().T, CENTER)


def true_log_density(poses: Tensor) -> Tensor:
    """Return the density that `draw` draws from: dR = 2 (1 - cos a) / a^2 dr, 8 pi^2 in all."""
    twist = twist_between(somewhere(), poses, CENTER)
    angle = twist[:, 3:].norm(dim=1)
    normal = torch.distributions.MultivariateNormal(torch.zeros(6).double(), scale_tril=factor())
    volume = 2 * (1 - angle.cos()) / angle.square()
    return normal.log_prob(twist) - volume.log() + math.log(8)


def fit(
    poses: Tensor, symmetries: Tensor | None = None, weights: Tensor | None = None
) -> PoseDensity:
    even = torch.full((len(poses),), -math.log(len(poses))).double()
    log_weights = even if weights is None else weights.log()
    return fit_density(poses, log_weights, CENTER, RADIUS, DIAMETER, symmetries)


def half_turn() -> Tensor:
    """Return the group of a half turn about an axis beside the object's center."""
    turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0])).double()
    turn[:3, 3] = torch.tensor([0.05, 0.0, 0.0])
    return torch.stack([torch.eye(4).double(), turn])


def grid_of_rotations(steps: int) -> Tensor:
    """Return rotations, about equally spaced, of equal volume: z-y-z angles, cos of the middle."""
    turn = (torch.arange(steps).double() + 0.5) * 2 * math.pi / steps
    tilt = torch.acos(1 - 2 * (torch.arange(steps // 2).double() + 0.5) / (steps // 2))
    a, b, c = (x.flatten() for x in torch.meshgrid(turn, tilt, turn, indexing="ij"))
    o = torch.zeros_like(a)
    first, last = (exp_so3(torch.stack([o, o, x], -1)) for x in (a, c))
    return first @ exp_so3(torch.stack([o, b, o], -1)) @ last


@pytest.mark.parametrize("group", [None, half_turn()], ids=["plain", "half turn"])
def test_it_integrates_to_one_over_rotations_and_positions(group: Tensor | None) -> None:
    """A grid of all rotations, with positions drawn about the poses' own and weighted."""
    g = generator(1)
    few = make_pose(random_rotation(12, generator=g).double(), 0.05 * torch.randn(12, 3).double())
    near = move_about(few.repeat(5, 1, 1), 0.3 * torch.randn(60, 6, generator=g).double(), CENTER)
    density = fit(near, group)
    rotations = grid_of_rotations(24)
    # of three normal distributions about the mean position; their density is divided out
    sigma = 0.35
    noise = torch.randn(len(rotations), 3, generator=g, dtype=torch.float64)
    place = density.mean + sigma * noise
    poses = make_pose(rotations, place - rotations @ CENTER)
    log_q = -0.5 * noise.square().sum(1) - 3 * math.log(sigma * math.sqrt(2 * math.pi))
    total = VOLUME * (log_density(density, poses) - log_q).exp().mean()
    # of the background, a hundredth, a part lies beyond all positions that were drawn
    assert float(total) == pytest.approx(1, abs=0.05)


def test_no_poses_gain_over_the_distribution_that_they_were_drawn_from() -> None:
    """Mean log density of fresh poses: below the truth's own, and near it, the nearer the more."""
    fresh = draw(400, generator(2))
    best = float(true_log_density(fresh).mean())
    few, many = (
        best - float(log_density(fit(draw(count, generator(3))), fresh).mean())
        for count in (100, 600)
    )
    assert 0 < many < 0.5
    assert many < few < 1.5


def test_held_out_poses_are_as_dense_as_fresh_ones() -> None:
    density = fit(draw(400, generator(4)))
    held, fresh = log_density_held_out(density), log_density(density, draw(400, generator(5)))
    assert float(held.mean()) == pytest.approx(float(fresh.mean()), abs=0.35)
    assert float(log_density(density, density.matrices).mean()) > float(fresh.mean()) + 0.4


def test_kernels_follow_a_ring() -> None:
    """Poses of an object that is round: the density is as high between the poses as at them."""
    g = generator(6)
    turn = torch.rand(400, generator=g).double() * 2 * math.pi
    o, origin = torch.zeros_like(turn), torch.zeros(3).double()
    about = somewhere() @ make_pose(exp_so3(torch.stack([o, o, turn], -1)), torch.zeros(3).double())
    noise = torch.randn(400, 6, generator=g).double()
    poses = move_about(about, noise * torch.tensor([0.003] * 3 + [0.02, 0.02, 0]), origin)
    density = fit_density(poses, o - math.log(400), origin, RADIUS, DIAMETER)
    around = torch.linspace(0, 2 * math.pi, 73).double()[:, None]
    spin = exp_so3(around * torch.tensor([0.0, 0, 1]).double())
    ring = somewhere() @ make_pose(spin, torch.zeros(3).double())
    across = move_about(ring, torch.tensor([0, 0, 0, 0.2, 0, 0]).double(), origin)
    on, off = log_density(density, ring), log_density(density, across)
    assert float(on.min()) > float(on.max()) - 3
    assert float(off.max()) < float(on.min()) - 8


def test_moving_everything_changes_nothing() -> None:
    """In another camera's frame, or another frame of the object, all densities are the same."""
    g = generator(7)
    poses, asked = draw(120, g), draw(30, g)
    before = log_density(fit(poses), asked)
    camera = somewhere(8)
    assert torch.allclose(log_density(fit(camera @ poses), camera @ asked), before, atol=1e-6)
    # the object's frame shifted, its center with it
    shift = make_pose(torch.eye(3).double(), torch.tensor([0.3, -0.2, 0.1]).double())
    moved = fit_density(
        poses @ torch.linalg.inv(shift),
        torch.full((120,), -math.log(120)).double(),
        CENTER + shift[:3, 3],
        RADIUS,
        DIAMETER,
    )
    assert torch.allclose(log_density(moved, asked @ torch.linalg.inv(shift)), before, atol=1e-6)


def test_equivalent_poses_share_the_density() -> None:
    g = generator(9)
    poses, asked, group = draw(100, g), draw(30, g), half_turn()
    known, plain = fit(poses, group), fit(poses)
    there, turned = log_density(known, asked), log_density(known, asked @ group[1])
    assert torch.allclose(there, turned, atol=1e-9)
    assert torch.allclose(there, log_density(plain, asked) - math.log(2), atol=0.03)


def test_which_of_the_equivalent_poses_the_particles_are_makes_no_difference() -> None:
    g, turn = generator(9), half_turn()[1]
    turn[:3, 3] = CENTER - turn[:3, :3] @ CENTER  # about the center
    group = torch.stack([torch.eye(4).double(), turn])
    poses, asked = draw(100, g), draw(30, g)
    mixed = poses.clone()
    mixed[::3] = mixed[::3] @ turn
    there = log_density(fit(poses, group), asked)
    assert torch.allclose(log_density(fit(mixed, group), asked), there, atol=1e-6)


def test_it_is_positive_anywhere_and_of_a_single_pose_too() -> None:
    density = fit(draw(80, generator(10)))
    away = somewhere()
    away[:3, 3] += 2.0
    assert -60 < float(log_density(density, away[None])[0]) < 0
    alone = torch.zeros(5).double()
    alone[2] = 1.0
    one = fit(draw(5, generator(11)), weights=alone)
    assert bool(log_density(one, draw(9, generator(12))).isfinite().all())
    single = fit(somewhere()[None])
    assert float(log_density(single, somewhere()[None])) > 10
    assert bool(log_density_held_out(single).isfinite().all())


def test_more_poses_than_kernels_are_thinned_fairly() -> None:
    g = generator(13)
    poses, fresh = draw(700, g), draw(200, g)
    weights = torch.rand(700, generator=g).double()
    shares = (weights / weights.sum()).log()
    density = fit_density(poses, shares, CENTER, RADIUS, DIAMETER, max_kernels=400)
    assert len(density.chosen) == len(density.chosen.unique()) == 400
    assert float(density.log_weights.exp().sum()) == pytest.approx(1)
    gap = float(true_log_density(fresh).mean() - log_density(density, fresh).mean())
    assert 0 < gap < 0.8


def test_pairs_of_twists_are_those_of_one_by_one() -> None:
    g = generator(14)
    count = 20
    R, t = random_rotation(2 * count, generator=g), torch.randn(2 * count, 3, generator=g)
    a, b = make_pose(R, t).double().split(count)
    pairs = pair_twists(split_poses(a, CENTER), split_poses(b, CENTER))
    assert torch.allclose(pairs, twist_between(a[:, None], b[None], CENTER), atol=2e-6)


def test_copies_of_poses_make_no_density_narrower() -> None:
    """As resampling makes them: copies have one kernel of their weight."""
    poses, g = draw(150, generator(30)), generator(31)
    index = torch.randint(150, (400,), generator=g)
    counts = torch.bincount(index, minlength=150).double()
    kept = counts > 0
    weighted = fit(poses[kept], weights=counts[kept] / 400)
    copied = fit(poses[index])
    fresh = draw(200, generator(32))
    assert len(copied.chosen) == len(weighted.chosen)
    assert torch.equal(copied.chosen, copied.chosen.sort().values)  # the first of each kind
    own = [float(one.log_weights.exp() @ log_density_held_out(one)) for one in (weighted, copied)]
    assert own[1] == pytest.approx(own[0], abs=1e-4)
    at_fresh = [log_density(one, fresh) for one in (weighted, copied)]
    assert torch.allclose(at_fresh[1], at_fresh[0], rtol=0, atol=1e-4)
    alone = fit(poses[:1].expand(30, 4, 4))
    assert bool(log_density_held_out(alone).isfinite().all())


def test_copies_of_an_object_that_may_be_turned_are_copies() -> None:
    """They are turned apart about its axis only after they have become one."""
    g, o = generator(40), torch.zeros(36).double()
    around = exp_so3(torch.stack([o, o, torch.arange(36).double() * 2 * math.pi / 36], -1))
    group = make_pose(around, CENTER - around @ CENTER)
    scale = torch.tensor([0.005] * 3 + [0.05] * 3).double()
    poses = move_about(somewhere(), torch.randn(60, 6, generator=g).double() * scale, CENTER)
    copied = fit(poses.repeat_interleave(5, dim=0), group)
    apart = fit(poses, group)
    fresh = move_about(somewhere(), torch.randn(200, 6, generator=g).double() * scale, CENTER)
    assert torch.allclose(log_density(copied, fresh), log_density(apart, fresh), atol=1e-4)
    held = [one.log_weights.exp() @ log_density_held_out(one) for one in (copied, apart)]
    assert float(held[0]) == pytest.approx(float(held[1]), abs=1e-4)
