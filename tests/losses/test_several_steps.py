"""The loss of a roll-out is the mean over its steps."""

import pytest
import torch

from posefilter.labels.membership import OnObject
from posefilter.losses.belief import BeliefNll, MaskDensity, PoseDensity
from posefilter.losses.displacement import Chamfer, Offset, Sides
from posefilter.losses.likelihood import Bce, Focal
from posefilter.losses.pose_loss import Confidence, SurfacePointLoss


@pytest.mark.parametrize(
    "loss",
    [
        Bce(OnObject()), Focal(OnObject()), Confidence(OnObject()), SurfacePointLoss(),
        Sides(OnObject()), Offset(), Chamfer(size=3),
        BeliefNll({"mask": MaskDensity(), "pose": PoseDensity()}),
    ],
    ids=lambda loss: type(loss).__name__,
)  # fmt: skip
def test_the_loss_of_several_steps_is_the_mean_over_them(loss, batch, model, make_trace) -> None:
    state = torch.tensor([[[6.0, 3.0], [15.0, 8.0]], [[7.0, 4.0], [2.0, 1.0]]]).double()
    log_p = torch.tensor([[0.3, 0.6], [0.8, 0.1]]).double().log()
    pose = batch.camera_from_object.expand(2, 2, 4, 4).clone()
    pose[..., 0, 3] += torch.tensor([[0.02, 0.05], [0.04, 0.01]]).double()
    latent = torch.rand(2, 2, 4, dtype=torch.float64)
    whole = loss(make_trace(state, log_p, None, pose, latent), batch, model)
    each = [
        loss(make_trace(state[t], log_p[t], None, pose[t], latent[t]), batch, model)
        for t in (slice(0, 1), slice(1, 2))
    ]
    torch.testing.assert_close(whole, (each[0] + each[1]) / 2)
    assert each[0].item() != pytest.approx(each[1].item())
