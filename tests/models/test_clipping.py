"""Clipping, and gradients that are not finite."""

import math
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parent))
from test_image_space import working

from posefilter.errors import UserError
from posefilter.models.cnn_patch import CnnPatch
from posefilter.models.image_space import ImageSpace
from posefilter.models.muon import Muon


def taught(
    method: ImageSpace, optimizer: torch.optim.Optimizer, wild: float, limit: float | None = 1.0
) -> Tensor:
    """Return how far the networks' parameters move by a gradient of ones, of which one entry is
    `wild`.
    """
    before = torch.cat([p.detach().flatten() for p in method.net.parameters()])
    for parameter in method.net.parameters():
        parameter.grad = torch.ones_like(parameter)
    first = next(method.net.parameters()).grad
    assert first is not None
    first.view(-1)[0] = wild
    method.configure_gradient_clipping(optimizer, limit)
    optimizer.step()
    return torch.cat([p.detach().flatten() for p in method.net.parameters()]) - before


@pytest.mark.parametrize("limit", [1.0, None])
@pytest.mark.parametrize("kind", ["sgd", "muon"])
# the last: finite, but its square is not
@pytest.mark.parametrize("wild", [math.inf, math.nan, 1e30])
def test_a_gradient_that_is_not_finite_is_not_applied(
    wild: float, kind: str, limit: float | None, caplog: pytest.LogCaptureFixture
) -> None:
    method = working(CnnPatch, 9)
    named = list(method.net.named_parameters())
    optimizer = (
        Muon(named)
        if kind == "muon"
        else torch.optim.SGD([p for _, p in named], lr=1.0, momentum=0.9)
    )
    moved = taught(method, optimizer, 5.0, limit)
    if kind == "sgd":
        assert moved.norm().item() == pytest.approx(limit or (len(moved) + 24) ** 0.5, rel=1e-3)
    assert moved.abs().max() > 0
    assert not caplog.records
    for _ in range(12):
        assert (taught(method, optimizer, wild, limit) == 0).all(), "not by momentum either"
    messages = [record.getMessage() for record in caplog.records]
    assert messages == [
        f"step 0 does not update net, whose gradient is not finite ({n} such steps so far)"
        for n in (1, 10)
    ]


def test_a_training_that_only_loses_its_gradients_ends() -> None:
    method = working(CnnPatch, 9)
    optimizer = torch.optim.SGD(method.parameters(), lr=1e-3)
    for wild in [math.nan] * 19 + [1.0] + [math.nan] * 19:  # never twenty in a row
        taught(method, optimizer, wild)
    with pytest.raises(
        FloatingPointError, match="gradient of net was not finite in 20 steps in a row"
    ):
        taught(method, optimizer, math.nan)


def test_another_way_of_clipping_is_refused() -> None:
    method = working(CnnPatch, 9)
    optimizer = torch.optim.SGD(method.parameters(), 0.1)
    with pytest.raises(UserError, match="gradient_clip_algorithm=value"):
        method.configure_gradient_clipping(optimizer, 1.0, "value")
