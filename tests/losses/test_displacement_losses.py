"""Motion losses against values worked out by hand and naive loops."""

import pytest
import torch

from posefilter.errors import UserError
from posefilter.labels.displacement import TowardsObject
from posefilter.labels.membership import OnObject
from posefilter.losses.displacement import Chamfer, DirectDisplacement, Offset, Sides

W = 20


def f64(x: list) -> torch.Tensor:
    return torch.tensor(x, dtype=torch.float64)


def test_offset_is_the_squared_distance_to_the_mask(batch, model, make_trace) -> None:
    trace = make_trace(
        f64([[[10.0, 3.0], [2.0, 0.0]]]), displacement=f64([[[1.0, 0.0], [0.0, -2.0]]])
    )
    # at (11, 3): 3 px from column 8; at (2, -2): (3, 4) from the corner (5, 2)
    want = (3**2 + (3**2 + 4**2)) / 2 / W**2
    assert Offset()(trace, batch, model).item() == pytest.approx(want)


def test_chamfer_equals_the_naive_double_loop(batch, model, make_trace) -> None:
    state, displacement = f64([[[12.3, 7.6], [6.2, 3.1]]]), f64([[[-1.0, 0.5], [0.3, 0.0]]])
    got = Chamfer(size=3)(make_trace(state, displacement=displacement), batch, model).item()
    mask = batch.mask[0, 0].nonzero().flip(-1).double()
    want = 0.0
    for place in (state + displacement)[0]:
        patch = torch.stack([place + f64([i, j]) for j in (-1, 0, 1) for i in (-1, 0, 1)])
        squared = torch.cdist(patch, mask) ** 2
        want += squared.min(1).values.mean().item() + squared.min(0).values.mean().item()
    assert got == pytest.approx(want / 2 / W**2)


def test_all_mask_pixels_or_an_even_selection_count(batch, model, make_trace) -> None:
    trace = make_trace(f64([[[12.3, 7.6]]]))
    everything, few = Chamfer(size=3, max_pixels=None), Chamfer(size=3, max_pixels=3)
    assert everything(trace, batch, model) == Chamfer(size=3, max_pixels=16)(trace, batch, model)
    assert few(trace, batch, model) != everything(trace, batch, model)


def test_towards_object_points_at_the_nearest_pixel_or_the_center_within_reach(
    batch, model, make_trace
) -> None:
    trace = make_trace(f64([[[12.0, 3.0], [6.0, 4.0]]]))
    near = TowardsObject()(trace, batch, model)[0, 0]
    assert near.tolist() == [[-4.0, 0.0], [0.0, 0.0]]
    inner = TowardsObject(margin_px=1)(trace, batch, model)[0, 0]
    assert inner[0].tolist() == [-5.0, 0.0]
    center = TowardsObject("center")(trace, batch, model)[0, 0]
    assert center.tolist() == [[-5.5, 0.5], [0.5, -0.5]]
    absent = batch._replace(mask=torch.zeros_like(batch.mask))
    assert not TowardsObject("center")(trace, absent, model).any(), "no object to go to"
    short = TowardsObject(max_displacement=0.1)(trace, batch, model)[0, 0]
    torch.testing.assert_close(short[0], f64([-2.0, 0.0]).to(short))
    with pytest.raises(UserError, match="nearest or center"):
        TowardsObject("rim")


def test_displacement_loss_is_zero_for_the_truth_and_huber_else(batch, model, make_trace) -> None:
    state = f64([[[12.0, 3.0], [6.0, 4.0]]])
    candidate_sampler = DirectDisplacement(TowardsObject(), width=0.1)
    assert (
        candidate_sampler(
            make_trace(state, displacement=f64([[[-4.0, 0.0], [0.0, 0.0]]])), batch, model
        ).item()
        == 0
    )
    got = candidate_sampler(
        make_trace(state, displacement=f64([[[0.0, 0.0], [1.0, 0.0]]])), batch, model
    ).item()
    # off by 4 px = 0.2 widths; by 1 px = 0.05 widths
    far, near = 0.1 * (0.2 - 0.05) / 0.1, 0.5 * 0.05**2 / 0.1
    assert got == pytest.approx((far + near) / 2)


def test_displacement_loss_has_no_gradient_to_earlier_steps(batch, model, make_trace) -> None:
    first = f64([[[0.5, 0.5]]]).requires_grad_()
    state = f64([[[12.0, 3.0]]])
    trace = make_trace(
        torch.cat([state, state + first]),
        displacement=torch.cat([first.detach(), f64([[[1.0, 1.0]]])]),
    )
    assert not DirectDisplacement(TowardsObject())(trace, batch, model).requires_grad
    # the canary: this one is taught through the roll-out
    assert Offset()(trace, batch, model).requires_grad


def test_sides_are_zero_for_the_true_box(batch, model, make_trace) -> None:
    # 2 cm about (6.5, 3.5), at 1 m and 100 px: 4.5..8.5 by 1.5..5.5
    small = model._replace(hull=model.points * 0.2)
    state = f64([[[6.0, 3.0], [15.0, 8.0]]])
    true = f64([[[1.5, 1.5, 2.5, 2.5], [0.0, 0.0, 0.0, 0.0]]]) / W
    sides = Sides(OnObject())
    assert sides(make_trace(state, latent=true), batch, small).item() == pytest.approx(
        0.0, abs=1e-6
    )
    wide = f64([[[1.5, 1.5, 6.5, 2.5], [0.0, 0.0, 0.0, 0.0]]]) / W
    want = 4 / W + 1 - 4 * 4 / (8 * 4)
    assert sides(make_trace(state, latent=wide), batch, small).item() == pytest.approx(want)


@pytest.mark.parametrize(
    "loss",
    [Offset(), Chamfer(3), DirectDisplacement(TowardsObject())],
    ids=lambda x: type(x).__name__,
)
def test_gradients(loss, batch, model, make_trace) -> None:
    displacement = f64([[[0.3, 0.4], [-0.4, 0.3]]])

    def value(m: torch.Tensor) -> torch.Tensor:
        return loss(make_trace(f64([[[12.1, 7.3], [6.2, 3.4]]]), displacement=m), batch, model)

    assert torch.autograd.gradcheck(value, (displacement.requires_grad_(),))


@pytest.mark.parametrize("size", [1, 2, 4, 5])
def test_chamfers_patch_has_as_many_pixels_as_it_says(size: int, batch, model, make_trace) -> None:
    """Also of an even side, where one more pixel lies to the right and below than to the left."""
    state = f64([[[12.3, 7.6], [6.2, 3.1]]])
    got = Chamfer(size=size)(make_trace(state), batch, model).item()
    mask = batch.mask[0, 0].nonzero().flip(-1).double()
    side = range(-((size - 1) // 2), size // 2 + 1)
    assert len(side) == size
    want = 0.0
    for place in state[0]:
        squared = torch.cdist(place + f64([[i, j] for j in side for i in side]), mask) ** 2
        want += squared.min(1).values.mean().item() + squared.min(0).values.mean().item()
    assert got == pytest.approx(want / 2 / W**2)
