"""What plain outputs mean."""

import pytest
import torch

from posefilter.errors import UserError
from posefilter.geometry.pose import invert, is_rigid, transform
from posefilter.geometry.rotation import matrix_from_quat_xyzw
from posefilter.nets.heads import (
    AbsoluteQuaternion,
    Bounded,
    Gated,
    NoPose,
    SurfacePointFragments,
    SurfacePointSixD,
    Unbounded,
    fill_depth,
)
from posefilter.types import ObjectModel


def thing(center: torch.Tensor, radius: float, seed: int = 3) -> ObjectModel:
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(seed)) * radius + center
    return ObjectModel("thing", points, center, radius, 2 * radius, torch.eye(4)[None], points)


def test_a_bounded_displacement_stays_in_the_frame_and_an_unbounded_does_not() -> None:
    g = torch.Generator().manual_seed(0)
    state = torch.rand(4, 100, 2, generator=g) * torch.tensor([99.0, 49.0])
    raw, logit = torch.randn(4, 100, 2, generator=g) * 5, torch.zeros(4, 100)
    goal = state + Bounded(0.3)(raw, logit, state, 100, 50)
    assert goal.min() >= 0
    assert (goal <= torch.tensor([99.0, 49.0])).all()
    assert (goal - state).abs().max() <= 30 + 1e-4
    out = state + Unbounded()(raw, logit, state, 100, 50)
    assert (out < 0).any()
    assert (out > 100).any()


def test_the_unit_scales_the_displacement() -> None:
    g = torch.Generator().manual_seed(0)
    raw, state = torch.randn(2, 7, 2, generator=g), torch.rand(2, 7, 2, generator=g) * 90
    one = Unbounded(1)(raw, raw[..., 0], state, 100, 50)
    assert torch.equal(one, raw)
    assert torch.equal(Unbounded(10.0)(raw, raw[..., 0], state, 100, 50), raw * 10)
    for width in (100, 160, 333):  # the default, and the bits of runs without a choice of unit
        assert torch.equal(Unbounded()(raw, raw[..., 0], state, width, 50), raw * (width / 2))
    assert not list(Unbounded().state_dict()), "weights of before have no unit"


def test_a_learned_unit_is_taught_by_the_loss() -> None:
    head, raw = Unbounded("learned"), torch.tensor([[[0.5, -1.0]]])
    state, goal = torch.zeros(1, 1, 2), torch.tensor([[[20.0, -40.0]]])
    optimizer = torch.optim.Adam(head.parameters(), lr=0.1)
    torch.testing.assert_close(
        head(raw, raw[..., 0], state, 100, 50), torch.tensor([[[5.0, -10.0]]])
    )
    for _ in range(200):
        optimizer.zero_grad()
        (head(raw, raw[..., 0], state, 100, 50) - goal).square().sum().backward()
        optimizer.step()
    torch.testing.assert_close(head.unit_px(100), torch.tensor(40.0), atol=0.1, rtol=0)


@pytest.mark.parametrize("unit", ["frame", 0, -1.0, float("nan"), float("inf"), True])
def test_an_unknown_unit_is_named_with_the_choices(unit: str | float) -> None:
    with pytest.raises(UserError, match=f"unit={unit}: choose half_frame, learned, or a number"):
        Unbounded(unit)


def test_a_particle_pushed_onto_an_edge_can_be_taught_back() -> None:
    state = torch.tensor([[[5.0, 20.0], [99.0, 49.0]]])
    # both are led off the frame, and kept on its edge
    raw = torch.tensor([[[-1.0, 0.0], [2.0, 2.0]]], requires_grad=True)
    displacement = Bounded(0.3)(raw, torch.zeros(1, 2), state, 100, 50)
    torch.testing.assert_close(state + displacement, torch.tensor([[[0.0, 20.0], [99.0, 49.0]]]))
    (displacement - torch.tensor([[[30.0, 0.0], [-50.0, -20.0]]])).square().sum().backward()
    assert raw.grad[0, 0, 0] < 0, "descent leads it inwards"
    assert (raw.grad[0, 1] > 0).all()


def test_who_is_there_stays_there() -> None:
    raw, state = torch.ones(1, 3, 2), torch.full((1, 3, 2), 20.0)
    logit = torch.tensor([[-9.0, 0.0, 9.0]]).requires_grad_()
    free, held = (
        Bounded(0.1)(raw, logit, state, 100, 80),
        Gated(Bounded(0.1))(raw.requires_grad_(), logit, state, 100, 80),
    )
    torch.testing.assert_close(
        held / free, torch.tensor([1.0, 0.5, 0.0])[None, :, None].expand(1, 3, 2), atol=2e-4, rtol=0
    )
    held.sum().backward()
    assert logit.grad is None
    assert raw.grad is not None


def test_the_pose_maps_the_predicted_object_point_to_the_measured_one() -> None:
    g = torch.Generator().manual_seed(1)
    center, radius = torch.tensor([0.01, 0.02, -0.03]), 0.1
    raw, point = torch.randn(2, 6, 9, generator=g), torch.rand(2, 6, 3, generator=g) + 0.5
    code = SurfacePointSixD()
    code.set_object(thing(center, radius))
    pose = code(raw, point).pose
    assert is_rigid(pose)
    back = transform(invert(pose), point[:, :, None])[:, :, 0]
    torch.testing.assert_close(back, center + radius * raw[..., 6:], atol=1e-5, rtol=0)
    moved = code(raw, point + torch.tensor([0.0, 0.0, 0.3])).pose  # the same outputs, farther away
    torch.testing.assert_close(
        moved[..., :3, 3] - pose[..., :3, 3], torch.tensor([0.0, 0.0, 0.3]).expand(2, 6, 3)
    )


def test_a_pose_of_fragments_is_that_of_the_likeliest() -> None:
    g = torch.Generator().manual_seed(2)
    center, radius, K = torch.tensor([0.01, 0.02, -0.03]), 0.1, 8
    code = SurfacePointFragments(K)
    code.set_object(thing(center, radius))
    raw, point = torch.randn(2, 6, code.width, generator=g), torch.rand(2, 6, 3, generator=g) + 0.5
    pose, said = code(raw, point)
    assert said is not None
    assert is_rigid(pose)
    torch.testing.assert_close(said.log_prob.logsumexp(-1), torch.zeros(2, 6), atol=1e-5, rtol=0)
    back = (transform(invert(pose), point[:, :, None])[:, :, 0] - center) / radius
    chosen = raw[..., 6 : 6 + K].argmax(-1)
    for i, j in ((0, 0), (1, 3)):
        k = int(chosen[i, j])
        want = code.centers[k] + code.reach * raw[i, j, 6 + K + 3 * k : 6 + K + 3 * k + 3]
        torch.testing.assert_close(back[i, j], want, atol=1e-5, rtol=0)
    cut = code.centers.clone()
    code.set_object(thing(center + 0.01, 2 * radius, seed=4))
    assert torch.equal(code.centers, cut), "fragments are cut once: what was learned is about these"


def test_absolute_pose_is_its_seven_outputs() -> None:
    raw = torch.tensor([[[0.0, 0.0, 2.0, 0.0, 0.1, 0.2, 0.9]]])
    pose = AbsoluteQuaternion()(raw, torch.rand(1, 1, 3)).pose
    torch.testing.assert_close(pose[0, 0, :3, 3], torch.tensor([0.1, 0.2, 0.9]))
    torch.testing.assert_close(
        pose[0, 0, :3, :3], matrix_from_quat_xyzw(torch.tensor([0.0, 0.0, 1.0, 0.0]))
    )
    assert NoPose()(raw[..., :0], torch.rand(1, 1, 3)).pose.shape == (1, 1, 4, 4)


def test_depth_is_filled_from_near_by_then_from_the_median() -> None:
    depth = torch.full((2, 1, 30, 30), 2.0)
    depth[0, 0, :, :15] = 1.0
    depth[0, 0, 4, 4] = 0.0
    depth[1] = 0.0
    filled = fill_depth(depth)
    torch.testing.assert_close(filled[0, 0, 4, 4], torch.tensor(1.0))
    assert torch.equal(filled[0, 0, 5], depth[0, 0, 5])
    assert (filled[1] == 1.0).all()
