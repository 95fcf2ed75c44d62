"""Pose losses against values worked out by hand."""

import math

import pytest
import torch

from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import exp_so3
from posefilter.labels.membership import OnObject
from posefilter.losses.pose_loss import Add, AddS, Confidence, SurfacePointLoss
from posefilter.types import Fragments

ON, OFF = [6.0, 3.0], [15.0, 8.0]


def places(*xy: list[float]) -> torch.Tensor:
    return torch.tensor([list(xy)], dtype=torch.float64)


def shifted(batch, *dx: float) -> torch.Tensor:
    pose = batch.camera_from_object[:, None].repeat(1, len(dx), 1, 1)
    pose[0, :, 0, 3] += torch.tensor(dx, dtype=torch.float64)
    return pose


def test_add_of_a_shift_is_its_length(batch, model, make_trace) -> None:
    trace = make_trace(places(ON, OFF), pose=shifted(batch, 0.02, 0.06))
    assert Add()(trace, batch, model).item() == pytest.approx(0.04, abs=1e-6)


def test_likelihood_weighted_add_listens_to_the_likely(batch, model, make_trace) -> None:
    log_p = torch.tensor([[0.75, 0.25]], dtype=torch.float64).log()
    trace = make_trace(places(ON, OFF), log_p, pose=shifted(batch, 0.02, 0.06))
    assert Add("likelihood")(trace, batch, model).item() == pytest.approx(0.03, abs=1e-6)


def test_a_quarter_turn_costs_add_but_not_add_s(batch, model, make_trace) -> None:
    turn = exp_so3(torch.tensor([0, 0, math.pi / 2], dtype=torch.float64))
    pose = make_pose(turn, batch.camera_from_object[0, :3, 3])[None, None]
    trace = make_trace(places(ON), pose=pose)
    # each point goes to its neighbor's place
    assert Add()(trace, batch, model).item() == pytest.approx(0.1 * math.sqrt(2))
    assert AddS()(trace, batch, model).item() == pytest.approx(0.0, abs=2e-6)
    trace = make_trace(places(ON), pose=shifted(batch, 0.02))
    want = (2 * 0.02 + 2 * 0.02) / 4
    assert AddS()(trace, batch, model).item() == pytest.approx(want, abs=1e-6)


def test_confidence_weighs_the_error_and_rejects_what_is_off_the_object(
    batch, model, make_trace
) -> None:
    log_p = torch.tensor([[0.5, 0.2, 0.4]], dtype=torch.float64).log()
    trace = make_trace(places(ON, ON, OFF), log_p, pose=shifted(batch, 0.02, 0.04, 0.5))
    w = 0.1
    fit = ((0.1 * 0.5 - w * math.log(0.5)) + (0.2 * 0.2 - w * math.log(0.2))) / 2
    want = fit - 0.25 * w * math.log(0.6)
    assert Confidence(OnObject(), weight=w)(trace, batch, model).item() == pytest.approx(
        want, abs=1e-6
    )


def test_confidence_is_best_where_error_times_confidence_is_the_weight(
    batch, model, make_trace
) -> None:
    c = torch.linspace(0.05, 0.95, 91, dtype=torch.float64)
    loss = Confidence(OnObject(), weight=0.1)
    lost = [
        loss(
            make_trace(places(ON), x.log().view(1, 1), pose=shifted(batch, 0.05)), batch, model
        ).item()
        for x in c
    ]
    assert c[int(torch.tensor(lost).argmin())].item() == pytest.approx(
        0.1 / (0.05 / 0.2), abs=0.011
    )


def test_own_point_measures_where_the_particles_surface_point_lands(
    batch, model, make_trace
) -> None:
    # off the object: no lesson, however wrong
    trace = make_trace(places(ON, OFF), pose=shifted(batch, 0.03, 9.0))
    assert SurfacePointLoss()(trace, batch, model).item() == pytest.approx(0.03 / 0.15, abs=1e-5)
    turn = exp_so3(torch.tensor([0, 0, math.pi], dtype=torch.float64))
    half = make_pose(turn, batch.camera_from_object[0, :3, 3])[None, None]
    # pixel (6, 3) lies half a pixel off the axis, at 1 m and 100 px
    far = 2 * math.hypot(0.5, 0.5) / 100
    assert SurfacePointLoss()(
        make_trace(places(ON), pose=half), batch, model
    ).item() == pytest.approx(far / 0.15, abs=1e-5)
    blind = batch._replace(depth=torch.zeros_like(batch.depth))
    assert SurfacePointLoss()(trace, blind, model).item() == 0
    # a wall behind the object that the mask's pixel shows: 1 m is farther than 1.2 radii
    wall = batch._replace(depth=torch.full_like(batch.depth, 2.0))
    assert SurfacePointLoss()(trace, wall, model).item() == 0
    near = batch._replace(depth=torch.full_like(batch.depth, 1.17))  # of a radius of 0.15
    assert SurfacePointLoss()(trace, near, model).item() > 0.1


def test_fragments_are_scored_by_the_true_fragment_and_the_position_in_it(
    batch, model, make_trace
) -> None:
    # pixel (6, 3), over the radius
    here = torch.tensor([-0.005, -0.005, 0.0], dtype=torch.float64) / 0.15
    centers = torch.stack([here + 0.1, here + 2.0])[None]  # the first is the true one
    share = torch.tensor([[[0.2, 0.8], [0.9, 0.1]]], dtype=torch.float64)
    place = torch.zeros(1, 2, 2, 3, dtype=torch.float64) + here + torch.tensor([0.03, 0.0, -0.01])
    said = Fragments(share.log(), place, centers, torch.tensor(0.1))
    trace = make_trace(places(ON, OFF), fragments=said)
    want = -math.log(0.2) + 0.3 * 0.4  # |0.03| + |-0.01| radii are 0.4 reaches
    assert SurfacePointLoss(fragment_weight=0.5, offset_weight=0.3)(
        trace, batch, model
    ).item() == pytest.approx(0.5 * want, abs=1e-6)


@pytest.mark.parametrize(
    "loss",
    [Add(), Add("likelihood"), AddS(), Confidence(OnObject()), SurfacePointLoss()],
    ids=lambda x: type(x).__name__,
)
def test_gradients(loss, batch, model, make_trace) -> None:
    tangent = torch.tensor(
        [[0.02, -0.01, 0.03, 0.2, -0.1, 0.3], [0.1, 0.0, 0.02, -0.1, 0.4, 0.0]], dtype=torch.float64
    )
    logit = torch.tensor([[0.4, -0.6]], dtype=torch.float64)

    def value(x: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
        pose = make_pose(exp_so3(x[:, 3:]), x[:, :3] + batch.camera_from_object[0, :3, 3])[None]
        return loss(
            make_trace(places(ON, OFF), torch.nn.functional.logsigmoid(z), pose=pose), batch, model
        )

    assert torch.autograd.gradcheck(value, (tangent.requires_grad_(), logit.requires_grad_()))
