"""The loss of an image does not depend on the others of its batch."""

from typing import Any

import pytest
import torch

from posefilter.labels.displacement import TowardsObject
from posefilter.labels.membership import OnObject, Quality
from posefilter.losses.belief import BeliefNll, MaskDensity, PoseDensity
from posefilter.losses.displacement import Chamfer, DirectDisplacement, Offset, Sides
from posefilter.losses.likelihood import BalancedBce, Bce, Focal
from posefilter.losses.pose_loss import Add, AddS, Confidence, SurfacePointLoss
from posefilter.losses.regression import Regression
from posefilter.losses.rgbd_chamfer import RgbdChamfer
from posefilter.types import Batch, BeliefBatch, Fragments, ParticleOutput, Particles, Trace

LOSSES = [
    Bce(OnObject()), Bce(OnObject(), "last"), BalancedBce(OnObject()), Focal(OnObject()),
    Focal(Quality()), Add(), Add("likelihood"), AddS(), Confidence(OnObject()), SurfacePointLoss(),
    Sides(OnObject()), Offset(), Chamfer(3), Chamfer(3, max_pixels=5), RgbdChamfer(3),
    DirectDisplacement(TowardsObject()), BeliefNll({"mask": MaskDensity()}),
    BeliefNll({"pose": PoseDensity()}),
]  # fmt: skip


def join(one: Any, other: Any) -> Any:
    """Return two traces as one of two images."""
    if isinstance(one, torch.Tensor) and one.dim():
        return torch.cat([one, other])
    if isinstance(one, Particles | ParticleOutput | BeliefBatch | Fragments | Trace | Batch):
        return type(one)(*(join(a, b) for a, b in zip(one, other, strict=True)))
    if type(one) is tuple:
        return tuple(join(a, b) for a, b in zip(one, other, strict=True))
    return one


@pytest.fixture
def images(batch: Batch, make_trace: Any) -> list[tuple[Trace, Batch]]:
    """Return two images, each with two steps of three particles, of which some are on the object;
    the masks differ in size, and the second's depth has holes.
    """
    g = torch.Generator().manual_seed(0)
    found = []
    for number in (0, 1):
        rgb = torch.rand(1, 3, 10, 20, generator=g).double()
        mask = batch.mask.clone()
        mask[..., 4:6, 5 : 7 + number] = False
        depth = batch.depth * (1 - 0.01 * number * (rgb[:, :1] < 0.5))
        pose = batch.camera_from_object.clone()
        pose[:, 0, 3] = 0.003 * number
        own = batch._replace(rgb=rgb, mask=mask, depth=depth, camera_from_object=pose)
        state = torch.rand(2, 3, 2, generator=g).double() * torch.tensor([10.0, 6.0])
        state[:, 0] = torch.tensor([6.0, 3.0])
        guess = pose[:, None].repeat(2, 3, 1, 1)
        guess[..., :3, 3] += 0.05 * torch.rand(2, 3, 3, generator=g)
        log_p = torch.rand(2, 3, generator=g).double().log()
        move = torch.rand(2, 3, 2, generator=g).double() * 4 - 2
        latent = torch.rand(2, 3, 4, generator=g).double()
        found.append((make_trace(state, log_p, move, guess, latent), own))
    return found


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: type(loss).__name__)
def test_the_loss_of_an_image_is_its_own(loss: Any, images: Any, model: Any) -> None:
    each = [loss(trace, batch, model) for trace, batch in images]
    both = loss(*join(*images), model)
    assert both.shape == (2,)
    torch.testing.assert_close(both, torch.cat(each).to(both))
    assert each[0].item() != pytest.approx(each[1].item())
    assert bool(both.isfinite().all())


def test_half_of_the_weight_is_on_each_side_over_all_steps(batch, model, make_trace) -> None:
    """Three positives and two negatives over two steps, and one that is not given to a class of
    its own: each of a class has the same share of one half.
    """
    on, off = [6.0, 3.0], [15.0, 8.0]
    state = torch.tensor([[on, on, off], [on, off, off]], dtype=torch.float64)
    p = torch.tensor([[0.8, 0.6, 0.3], [0.9, 0.2, 0.4]], dtype=torch.float64)
    got = BalancedBce(OnObject())(make_trace(state, p.log()), batch, model).item()
    right = torch.tensor([0.8, 0.6, 0.9]).double().log().sum() / 3
    wrong = torch.tensor([0.7, 0.8, 0.6]).double().log().sum() / 3
    assert got == pytest.approx(float(-0.5 * (right + wrong)))
    only = make_trace(state[:, :1], p[:, :1].log())
    got = BalancedBce(OnObject())(only, batch, model).item()
    assert got == pytest.approx(float(-torch.tensor([0.8, 0.9]).double().log().mean()))


def test_a_confidence_by_hand(batch, model, make_trace) -> None:
    """On the object e c - w log c, off it a quarter of -w log(1 - c); means of each."""
    state = torch.tensor([[[6.0, 3.0], [7.0, 4.0], [15.0, 8.0], [16.0, 8.0]]]).double()
    c = torch.tensor([[0.5, 0.8, 0.2, 0.4]]).double()
    pose = batch.camera_from_object[:, None].repeat(1, 4, 1, 1)
    pose[0, 0, 0, 3] += 0.04  # 0.2 diameters
    log = c.log()[0]
    fit = (0.2 * 0.5 - 0.5 * log[0] - 0.5 * log[1]) / 2
    reject = -0.5 * ((1 - c[0, 2]).log() + (1 - c[0, 3]).log()) / 2
    got = Confidence(OnObject())(make_trace(state, c.log(), None, pose), batch, model)
    assert got.item() == pytest.approx(float(fit + 0.25 * reject), rel=1e-5)


def test_regression_by_hand(batch, model, make_trace) -> None:
    """Scores of 50 and -50 where 100 and -100 are expected; weights are even."""

    def label(trace: Trace, batch: Batch, model: Any) -> torch.Tensor:
        return torch.tensor([[[0.0, 0.0]], [[100.0, -100.0]]]).double()

    scores = torch.tensor([[9.0, 9.0], [50.0, -20.0]]).double()
    trace = make_trace(torch.zeros(2, 2, 2).double(), scores)
    assert Regression(label)(trace, batch, model).item() == pytest.approx((0.25 + 0.64) / 2)
    assert Regression(label, scale=200.0)(trace, batch, model).item() == pytest.approx(0.89 / 8)


def test_a_displacement_is_judged_in_both_directions_of_each_of_three(
    batch, model, make_trace
) -> None:
    """Off by 4, 2 and 0 px of 20 along u, by 1 px along v: all within a width of 1."""
    state = torch.tensor([[[12.0, 3.0], [10.0, 3.0], [6.0, 3.0]]]).double()
    move = torch.tensor([[[0.0, 1.0], [0.0, 1.0], [0.0, 1.0]]]).double()
    got = DirectDisplacement(TowardsObject(), width=1.0)(
        make_trace(state, displacement=move), batch, model
    )
    squares = (16 + 1) + (4 + 1) + (0 + 1)
    assert got.item() == pytest.approx(0.5 * squares / 400 / 3)


def test_an_object_of_one_pixel_has_a_distance(batch, model, make_trace) -> None:
    mask = torch.zeros_like(batch.mask)
    mask[0, 0, 3, 6] = True
    small = batch._replace(mask=mask)
    trace = make_trace(torch.tensor([[[9.0, 3.0]]]).double())
    assert Chamfer(1)(trace, small, model).item() == pytest.approx(2 * 9 / 400)
    assert Offset()(trace, small, model).item() == pytest.approx(9 / 400)
    rgb = torch.zeros_like(batch.rgb)
    rgb[0, 0, 3, 6] = 0.5
    lit = small._replace(rgb=rgb)
    assert RgbdChamfer(1)(trace, lit, model).item() == pytest.approx(2 * 0.25)
    assert Chamfer(1)(trace, batch._replace(mask=mask & False), model).item() == 0
