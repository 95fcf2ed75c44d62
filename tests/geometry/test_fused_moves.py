"""Poses that are moved row by row are those of the reference, up to rounding."""

import pytest
import torch
from torch import Tensor

from posefilter.geometry import fused_moves
from posefilter.geometry.pose import is_rigid, make_pose, move_about
from posefilter.geometry.rotation import random_rotation
from posefilter.geometry.spaces import PoseSpace

CENTER = (0.1, -0.2, 0.05)


def draw(*lead: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return make_pose(random_rotation(*lead), torch.randn(*lead, 3)).to(dtype)


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-9, 1e-4, 0.03, 1.0, 40.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_moves_are_those_of_the_reference(size: float, dtype: torch.dtype) -> None:
    poses, tangent = draw(2, 50, dtype=dtype), (size * torch.randn(2, 50, 6)).to(dtype)
    moved = fused_moves.move(poses, tangent, CENTER)
    expected = move_about(poses, tangent, poses.new_tensor(CENTER))
    assert moved.dtype == dtype
    # a turn of 40 rad is rounded to 2e-6 of itself
    scale = 1e-6 if dtype == torch.float32 else 1e-14
    torch.testing.assert_close(moved, expected, rtol=0, atol=scale * max(1, 10 * size))
    assert is_rigid(moved)


def test_parts_follow_one_another(monkeypatch: pytest.MonkeyPatch) -> None:
    poses, tangent = draw(3, 21), 0.1 * torch.randn(3, 21, 6)
    whole = fused_moves.move(poses, tangent.double(), CENTER)
    monkeypatch.setattr(fused_moves, "PART", 10)
    assert torch.equal(fused_moves.move(poses, tangent.double(), CENTER), whole)


def test_leading_shapes_broadcast_and_poses_may_be_views() -> None:
    poses, tangent = draw(4, 1), 0.1 * torch.randn(7, 6).double()
    expected = move_about(poses, tangent, poses.new_tensor(CENTER))
    torch.testing.assert_close(fused_moves.move(poses, tangent, CENTER), expected)
    turned = poses.transpose(-1, -2).contiguous().transpose(-1, -2)
    torch.testing.assert_close(fused_moves.move(turned, tangent, CENTER), expected)
    none = fused_moves.move(draw(2, 0), torch.zeros(2, 0, 6).double(), CENTER)
    assert none.shape == (2, 0, 4, 4)


def test_what_is_moved_is_left_alone() -> None:
    poses, tangent = draw(5), torch.randn(5, 6).double()
    before = poses.clone(), tangent.clone()
    fused_moves.move(poses, tangent, CENTER)
    assert torch.equal(poses, before[0])
    assert torch.equal(tangent, before[1])


def test_a_space_keeps_the_gradient_where_one_is_asked_for() -> None:
    space = PoseSpace(CENTER, 0.1)
    poses, tangent = draw(6), (0.1 * torch.randn(6, 6)).double().requires_grad_()
    space.move(poses, tangent).sum().backward()  # type: ignore[no-untyped-call]
    assert tangent.grad is not None
    assert bool(tangent.grad.abs().sum() > 0)
    assert not fused_moves.applies(poses, tangent)
    with torch.no_grad():
        assert fused_moves.applies(poses, tangent)
        plain = space.move(poses, tangent)
    torch.testing.assert_close(space.move(poses, tangent).detach(), plain)
