"""Likelihood losses against values worked out by hand."""

import math

import pytest
import torch

from posefilter.errors import UserError
from posefilter.labels.membership import OnObject, Quality
from posefilter.losses.likelihood import BalancedBce, Bce, Focal, log1mexp

ON, OFF = [6.0, 3.0], [15.0, 8.0]


def logs(*p: float) -> torch.Tensor:
    return torch.tensor([p], dtype=torch.float64).log()


def places(*xy: list[float]) -> torch.Tensor:
    return torch.tensor([list(xy)], dtype=torch.float64)


def test_bce_is_the_mean_of_minus_the_logs_of_what_came_true(batch, model, make_trace) -> None:
    trace = make_trace(places(ON, OFF, OFF, OFF), logs(0.8, 0.1, 0.2, 0.5))
    want = -(math.log(0.8) + math.log(0.9) + math.log(0.8) + math.log(0.5)) / 4
    assert Bce(OnObject())(trace, batch, model).item() == pytest.approx(want)


def test_balanced_bce_gives_the_one_positive_half_the_weight(batch, model, make_trace) -> None:
    trace = make_trace(places(ON, OFF, OFF, OFF), logs(0.8, 0.1, 0.2, 0.5))
    want = -math.log(0.8) / 2 - (math.log(0.9) + math.log(0.8) + math.log(0.5)) / 6
    assert BalancedBce(OnObject())(trace, batch, model).item() == pytest.approx(want)
    only = make_trace(places(OFF, OFF), logs(0.1, 0.3))
    want = -(math.log(0.9) + math.log(0.7)) / 2
    assert BalancedBce(OnObject())(only, batch, model).item() == pytest.approx(want)


def test_focal_scales_the_entropy_by_how_wrong_it_is(batch, model, make_trace) -> None:
    trace = make_trace(places(ON, OFF), logs(0.8, 0.1))
    want = (0.25 * 0.2**2 * -math.log(0.8) + 0.75 * 0.1**2 * -math.log(0.9)) / 2
    assert Focal(OnObject())(trace, batch, model).item() == pytest.approx(want, rel=1e-6)
    plain = Focal(OnObject(), gamma=0.0, alpha=0.5)(trace, batch, model) * 2
    torch.testing.assert_close(plain, Bce(OnObject())(trace, batch, model))


def test_steps_choose_which_outputs_count(batch, model, make_trace) -> None:
    state = torch.cat([places(OFF), places(ON)])
    trace = make_trace(state, torch.cat([logs(0.5), logs(0.25)]))
    assert Bce(OnObject(), "last")(trace, batch, model).item() == pytest.approx(-math.log(0.25))
    both = -(math.log(0.5) + math.log(0.25)) / 2
    assert Bce(OnObject(), "all")(trace, batch, model).item() == pytest.approx(both)
    with pytest.raises(UserError, match="last or all"):
        Bce(OnObject(), "first")(trace, batch, model)


def test_patch_label_counts_a_patch_that_meets_the_mask(batch, model, make_trace) -> None:
    trace = make_trace(places([9.0, 3.0], [10.0, 3.0], [13.0, 3.0]))
    assert OnObject(1)(trace, batch, model).tolist() == [[[0, 0, 0]]]
    assert OnObject(3)(trace, batch, model).tolist() == [[[1, 0, 0]]]
    assert OnObject(9)(trace, batch, model).tolist() == [[[1, 1, 0]]]


def test_quality_falls_with_the_pose_error_and_is_nothing_off_the_object(
    batch, model, make_trace
) -> None:
    pose = batch.camera_from_object[:, None].repeat(1, 3, 1, 1)
    pose[0, 1, 0, 3] += 0.02  # one tenth of the diameter
    trace = make_trace(places(ON, ON, OFF), pose=pose)
    label = Quality(scale=0.1)(trace, batch, model)[0, 0]
    torch.testing.assert_close(
        label, torch.tensor([1.0, math.exp(-1.0), 0.0], dtype=label.dtype), atol=1e-4, rtol=0
    )


def test_log_not_is_exact_and_its_slope_finite_at_both_ends() -> None:
    logit = torch.tensor(
        [-40.0, -3.0, 0.0, 5.0, 15.0, 28.0, 75.0], dtype=torch.float32, requires_grad=True
    )
    out = log1mexp(torch.nn.functional.logsigmoid(logit))
    torch.testing.assert_close(out, torch.nn.functional.logsigmoid(-logit), rtol=1e-5, atol=1e-7)
    out.sum().backward()
    torch.testing.assert_close(logit.grad, -torch.sigmoid(logit.detach()), rtol=1e-4, atol=1e-7)
    far = torch.tensor([500.0], requires_grad=True)
    log1mexp(torch.nn.functional.logsigmoid(far)).backward()
    assert torch.isfinite(far.grad).all()


@pytest.mark.parametrize(
    "loss",
    [Bce(OnObject()), BalancedBce(OnObject()), Focal(OnObject())],
    ids=lambda x: type(x).__name__,
)
def test_gradients(loss: Bce, batch, model, make_trace) -> None:
    logit = torch.tensor([[0.3, -1.2, 2.0]], dtype=torch.float64, requires_grad=True)

    def value(x: torch.Tensor) -> torch.Tensor:
        return loss(
            make_trace(places(ON, OFF, OFF), torch.nn.functional.logsigmoid(x)), batch, model
        )

    detached = type(loss).weigh is Focal.weigh
    assert torch.autograd.gradcheck(value, (logit,)), detached
