"""The loss of heatmaps is a sum of divergences of coins, and so known in closed form."""

import math
from typing import NamedTuple

import pytest
import torch
from torch import Tensor
from torch.distributions import Bernoulli, kl_divergence

from posefilter.geometry.keypoints import draw_gaussians, project_keypoints
from posefilter.losses.heatmaps import Heatmaps

STRIDE = 2


class Encoding(NamedTuple):
    """An image of 10 x 20 pixels, with maps of 5 x 10 cells."""

    logits: Tensor
    keypoints: Tensor
    stride: int = STRIDE


@pytest.fixture
def keypoints() -> Tensor:
    return torch.tensor([[0.01, 0.0, 0.0], [-0.03, 0.02, 0.1]], dtype=torch.float64)


def test_it_is_the_divergence_of_each_cell(batch, model, make_trace, keypoints: Tensor) -> None:
    pixels, ahead = project_keypoints(
        batch.camera_from_object[:, None], keypoints, batch.intrinsics
    )
    target = draw_gaussians(pixels[:, 0], ahead[:, 0], 5, 10, STRIDE, 1.5)
    logits = torch.randn(1, 2, 5, 10, dtype=torch.float64)
    trace = make_trace(torch.zeros(1, 1, 2))._replace(encoding=Encoding(logits, keypoints))
    cells = kl_divergence(Bernoulli(probs=target), Bernoulli(logits=logits))
    found = Heatmaps(1.5)(trace, batch, model)
    torch.testing.assert_close(found, cells.sum((2, 3)).mean(1))
    # a wider Gaussian is another target
    assert Heatmaps(3.0)(trace, batch, model).item() != pytest.approx(found.item(), rel=1e-3)


def test_without_an_opinion_an_empty_map_costs_a_bit_a_cell(
    batch, model, make_trace, keypoints: Tensor
) -> None:
    behind = batch.camera_from_object.clone()
    behind[:, 2, 3] = -1
    logits = torch.zeros(1, 2, 5, 10, dtype=torch.float64)
    trace = make_trace(torch.zeros(1, 1, 2))._replace(encoding=Encoding(logits, keypoints))
    lost = Heatmaps()(trace, batch._replace(camera_from_object=behind), model)
    assert lost.tolist() == pytest.approx([50 * math.log(2)])
