"""Messages between parts: against double loops, at the limits of the kernel, and on a grid where
each part alone is ambiguous.
"""

import math

import pytest
import torch
from torch import Tensor

from posefilter.errors import UserError
from posefilter.filters.messages import WithinParts, log_kernel, pass_messages, pull_message
from posefilter.filters.resample import Multinomial, NoResampling, Systematic
from posefilter.filters.transport import EnsembleTransform
from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import angle_between, exp_so3
from posefilter.geometry.spaces import PartsSpace
from posefilter.types import Particles

B = 2
WIDE = torch.tensor(1e6)


def draw_poses(count: int, seed: int, spread: float = 0.03, images: int = B) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    turn = 0.3 * torch.randn(images, count, 3, generator=g, dtype=torch.float64)
    place = spread * torch.randn(images, count, 3, generator=g, dtype=torch.float64)
    return make_pose(exp_so3(turn), place + place.new_tensor([0.0, 0.0, 0.8]))


def draw(*size: int, seed: int = 0) -> Tensor:
    return torch.randn(*size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def kernel_by_hand(a: Tensor, b: Tensor, joint: Tensor, shift: float, turn: float) -> float:
    distance = float(((a[:3, :3] @ joint + a[:3, 3]) - (b[:3, :3] @ joint + b[:3, 3])).norm())
    angle = math.acos(min(1.0, (float((a[:3, :3].T @ b[:3, :3]).trace()) - 1) / 2))
    return math.exp(-0.5 * (distance / shift) ** 2 - 0.5 * (angle / turn) ** 2)


@pytest.mark.parametrize("parts", [2, 3])
def test_beliefs_are_those_of_double_loops(parts: int) -> None:
    count, shift, turn = 11, 0.03, 0.4
    poses, unary = draw_poses(count, 1), draw(B, count)
    joints = 0.1 * draw(parts, parts, 3, seed=2)
    blocks = PartsSpace((0.0, 0.0, 0.0), 0.1, parts=parts).split(count)
    found = pass_messages(unary, poses, blocks, joints, *map(torch.tensor, (shift, turn)))
    for b in range(B):
        for s, own in enumerate(blocks):
            for i in range(own.start, own.stop):
                expected = float(unary[b, i])
                for t, other in enumerate(blocks):
                    if t == s:
                        continue
                    message = sum(
                        math.exp(float(unary[b, j]))
                        * kernel_by_hand(poses[b, i], poses[b, j], joints[s, t], shift, turn)
                        for j in range(other.start, other.stop)
                    )
                    expected += math.log(message / (other.stop - other.start))
                assert float(found[b, i]) == pytest.approx(expected, abs=1e-6)


def test_the_kernel_is_of_the_joints_shift_and_of_the_angle() -> None:
    """A turn about the joint costs the angle alone; far from the joint it costs a shift too."""
    start, joint = draw_poses(1, 3), torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64)
    R = exp_so3(torch.tensor([0.0, 0.0, 0.2], dtype=torch.float64))
    about_joint = make_pose(R, joint - R @ joint)
    shift, turn = torch.tensor(0.01), torch.tensor(0.1)
    found = log_kernel(start, start @ about_joint, joint, shift, turn)
    assert torch.allclose(found, torch.full_like(found, -0.5 * 2**2), atol=1e-9)
    elsewhere = log_kernel(start, start @ about_joint, -joint, shift, turn)
    chord = 2 * 0.2 * math.sin(0.1)
    expected = -0.5 * (2**2 + (chord / 0.01) ** 2)
    assert torch.allclose(elsewhere, torch.full_like(elsewhere, expected), atol=1e-9)
    assert angle_between(start[..., :3, :3], (start @ about_joint)[..., :3, :3]).allclose(
        torch.tensor(0.2, dtype=torch.float64)
    )


def test_equal_poses_agree_wholly_in_single_precision_too() -> None:
    poses = draw_poses(40, 4).float()
    found = log_kernel(
        poses, poses, torch.tensor([0.1, 0, 0]), torch.tensor(1e-3), torch.tensor(1e-3)
    )
    assert torch.equal(found.diagonal(dim1=1, dim2=2), torch.zeros(B, 40))


def test_the_message_of_a_single_particle_is_the_kernel() -> None:
    """Whatever its weight, which is normalized."""
    receiver, sender = draw_poses(5, 5), draw_poses(1, 6)
    kernel = log_kernel(
        receiver, sender, torch.zeros(3).double(), torch.tensor(0.02), torch.tensor(0.3)
    )
    found = pull_message(kernel, torch.full((B, 1), -7.0, dtype=torch.float64))
    assert torch.allclose(found, kernel[..., 0], atol=1e-12)


def test_a_wide_kernel_leaves_the_unaries() -> None:
    """Up to a constant of each part."""
    unary, blocks = draw(B, 10), [slice(0, 5), slice(5, 10)]
    found = pass_messages(
        unary, draw_poses(10, 7), blocks, torch.zeros(2, 2, 3).double(), WIDE, WIDE
    )
    added = found - unary
    for block in blocks:
        assert torch.allclose(added[:, block], added[:, block][:, :1].expand(-1, 5), atol=1e-9)


def test_what_is_known_of_no_part_changes_no_order() -> None:
    """A constant of one part's unary potential is one of all beliefs, since parts are compared."""
    unary, blocks, poses = draw(B, 10), [slice(0, 5), slice(5, 10)], draw_poses(10, 8)
    rest = (poses, blocks, torch.zeros(2, 2, 3).double(), torch.tensor(0.03), torch.tensor(0.4))
    shifted = torch.cat([unary[:, :5] + 4, unary[:, 5:]], dim=1)
    assert torch.allclose(pass_messages(shifted, *rest), pass_messages(unary, *rest) + 4, atol=1e-9)


def test_two_parts_with_as_many_particles_have_the_same_mass() -> None:
    unary, blocks, poses = 3 * draw(B, 12), [slice(0, 6), slice(6, 12)], draw_poses(12, 9)
    joint = draw(3).expand(2, 2, 3)
    found = pass_messages(unary, poses, blocks, joint, torch.tensor(0.02), torch.tensor(0.2))
    assert torch.allclose(found[:, :6].logsumexp(1), found[:, 6:].logsumexp(1), atol=1e-9)


def test_parts_that_are_ambiguous_alone_find_the_pose_that_both_allow() -> None:
    """The best of neither part is the joint's, which a sharp kernel and the whole grid tell."""
    places = torch.cartesian_prod(*[torch.linspace(-0.1, 0.1, 5).double()] * 2)
    turns = torch.tensor([0.0, math.pi / 2, math.pi]).double()
    R = exp_so3(turns[:, None] * turns.new_tensor([0.0, 0.0, 1.0]))
    flat = torch.cat([places, torch.full_like(places[:, :1], 0.8)], dim=1)
    grid = make_pose(R[:, None].expand(-1, len(flat), 3, 3), flat.expand(3, -1, -1)).flatten(0, 1)
    a, b = torch.full((len(grid),), -5.0).double(), torch.full((len(grid),), -5.0).double()
    a[7], a[40] = 2.0, 1.5  # each prefers a pose that the other does not know
    b[60], b[40] = 2.0, 1.5
    assert (int(a.argmax()), int(b.argmax())) == (7, 60)
    poses, unary = torch.cat([grid, grid])[None], torch.cat([a, b])[None]
    blocks = [slice(0, len(grid)), slice(len(grid), 2 * len(grid))]
    joints = torch.zeros(2, 2, 3).double()
    found = pass_messages(unary, poses, blocks, joints, torch.tensor(0.01), torch.tensor(0.1))
    for block in blocks:
        assert int(found[0, block].argmax()) == 40


def particles(count: int, seed: int = 0) -> Particles:
    log_weights = (3 * draw(B, count, seed=seed)).float().log_softmax(1)
    return Particles(draw_poses(count, seed).float(), torch.zeros(B, count, 0), log_weights,
                     torch.arange(count).expand(B, count))  # fmt: skip


@pytest.mark.parametrize("scheme", [Systematic(), Multinomial()])
@pytest.mark.parametrize(("count", "children"), [(30, 30), (50, 20), (31, 17)])
@pytest.mark.parametrize("parts", [2, 3])
def test_resampling_moves_no_mass_between_parts(
    scheme: Systematic | Multinomial, count: int, children: int, parts: int
) -> None:
    space, before = PartsSpace((0.0, 0.0, 0.0), 0.1, parts=parts), particles(count)
    new = WithinParts(scheme)(before, children, space, torch.Generator().manual_seed(0))
    assert new.ancestors.shape == new.log_weights.shape == (B, children)
    for old_block, block in zip(space.split(count), space.split(children), strict=True):
        ancestors = new.ancestors[:, block]
        assert bool(((ancestors >= old_block.start) & (ancestors < old_block.stop)).all())
        mass = before.log_weights[:, old_block].logsumexp(1)
        assert torch.allclose(new.log_weights[:, block].logsumexp(1), mass, atol=1e-5)


def test_a_part_without_weight_keeps_its_particles() -> None:
    space, before = PartsSpace((0.0, 0.0, 0.0), 0.1, parts=2), particles(20)
    log_weights = before.log_weights.clone()
    log_weights[:, 10:] = -torch.inf
    new = WithinParts(Systematic())(
        before._replace(log_weights=log_weights), 20, space, torch.Generator().manual_seed(0)
    )
    assert torch.equal(new.ancestors[:, 10:], torch.arange(10, 20).expand(B, 10))
    assert bool((new.log_weights[:, 10:] == -torch.inf).all())


def test_each_part_keeps_its_particles_where_nothing_is_drawn() -> None:
    space, before = PartsSpace((0.0, 0.0, 0.0), 0.1, parts=3), particles(20)
    new = WithinParts(NoResampling())(before, 20, space, torch.Generator())
    assert torch.equal(new.ancestors, torch.arange(20).expand(B, 20))
    assert torch.allclose(new.log_weights, before.log_weights, atol=1e-5)


def test_schemes_that_mix_particles_are_refused() -> None:
    space = PartsSpace((0.0, 0.0, 0.0), 0.1, parts=2)
    with pytest.raises(UserError, match="draws ancestors"):
        WithinParts(EnsembleTransform())(particles(8), 8, space, torch.Generator().manual_seed(0))


@pytest.mark.parametrize(("count", "parts"), [(6, 2), (7, 2), (8, 3), (1000, 3), (3, 3)])
def test_blocks_follow_one_another_and_are_as_long(count: int, parts: int) -> None:
    blocks = PartsSpace((0.0, 0.0, 0.0), 0.1, parts=parts).split(count)
    assert [i for block in blocks for i in range(block.start, block.stop)] == [*range(count)]
    sizes = [block.stop - block.start for block in blocks]
    assert max(sizes) - min(sizes) <= 1
