"""How a cloud of pixels bounds the object: by where the particles are, and by what they say."""

import sys
from pathlib import Path

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parent))
from test_image_space import working
from toy import W, scenes

from posefilter.models.box_heads import QuantileBox, VotedBox
from posefilter.models.cnn_patch import CnnPatch
from posefilter.models.image_space import ImageSpace
from posefilter.types import Batch, Trace


def made(
    method: ImageSpace, batch: Batch, places: list[list[float]], weights: Tensor, boxes: Tensor
) -> Trace:
    """Return a run that ends with particles at these places (N, 2), of weights (B, N), that tell
    boxes (N, 4) [px].
    """
    with torch.no_grad():
        trace: Trace = method.predict_step(batch, 0)
    state = torch.tensor(places).expand(len(weights), -1, -1)
    latent = torch.cat([state - boxes[:, :2], boxes[:, 2:] - state], -1) / W
    particles = trace.particles[-1]._replace(state=state, log_weights=weights.log())
    return trace._replace(
        particles=(particles,), outputs=(trace.outputs[-1]._replace(latent=latent),)
    )


def test_a_box_of_where_particles_are_leaves_out_the_lightest_tails() -> None:
    method, batch = working(CnnPatch, 9).eval(), scenes(2)
    # in the order of neither axis; the second image has the same places, all of one weight
    places = [
        [40.0, 18.0],
        [2.0, 20.0],
        [20.0, 12.0],
        [50.0, 2.0],
        [4.0, 26.0],
        [30.0, 16.0],
        [10.0, 6.0],
    ]
    uneven = torch.tensor([0.03, 0.02, 0.50, 0.04, 0.02, 0.33, 0.06])
    weights = torch.stack([uneven, torch.full((7,), 1 / 7)])
    trace = made(method, batch, places, weights, torch.zeros(7, 4))

    def box(quantile: float) -> list[list[float]]:
        found: list[list[float]] = QuantileBox(size=3, quantile=quantile)(
            trace, batch, method.object_model
        ).tolist()
        return found

    all_of_them = [2 - 1.5, 2 - 1.5, 50 + 1.5, 26 + 1.5]
    assert box(0.0) == [all_of_them, all_of_them]
    # left: x = 2 and 4 weigh 0.04, with 10 it would be 0.10; right: 50 weighs 0.04, with 40 it
    # would be 0.07
    # top: y = 2 weighs 0.04, with 6 it would be 0.10; bottom: 26 and 20 weigh 0.04, with 18 it
    # would be 0.07
    # where all weigh a seventh, none is as light as 0.05
    assert box(0.05) == [[10 - 1.5, 6 - 1.5, 40 + 1.5, 18 + 1.5], all_of_them]
    # left: 2, 4 and 10 weigh 0.10, with 20 it would be 0.60; right: 50 and 40 weigh 0.07, with 30
    # it would be 0.40
    # top: 2 and 6 weigh 0.10, with 12 it would be 0.60; bottom: 26, 20 and 18 weigh 0.07, with 16
    # it would be 0.40
    # where all weigh a seventh, one goes on each side
    assert box(0.2) == [
        [20 - 1.5, 12 - 1.5, 30 + 1.5, 16 + 1.5],
        [4 - 1.5, 6 - 1.5, 40 + 1.5, 20 + 1.5],
    ]


def test_a_box_that_is_voted_for_ignores_what_the_lesser_weight_says() -> None:
    method, batch = working(CnnPatch, 9).eval(), scenes(2)
    places = [[3.0, 40.0], [25.0, 15.0], [50.0, 5.0], [30.0, 20.0], [60.0, 30.0]]
    right, wrong = torch.tensor([20.0, 10.0, 40.0, 30.0]), torch.tensor([44.0, 2.0, 60.0, 12.0])
    boxes = torch.stack([wrong, right, wrong, right, wrong])
    # the two right ones: 0.62, and 0.4
    weights = torch.tensor([[0.10, 0.42, 0.13, 0.20, 0.15], [0.2] * 5])
    found = VotedBox()(made(method, batch, places, weights, boxes), batch, method.object_model)
    torch.testing.assert_close(found, torch.stack([right, wrong]))  # a median, so no mix of the two
    # where all differ, each side has its own order: from particle 1 on the weights add up to 0.10,
    # 0.52, ...; the tops
    # fall, and from particle 5 back they add up to 0.15, 0.35, 0.48, 0.90: both times it is
    # particle 2 that passes a half
    differ = torch.stack(
        [
            torch.arange(1.0, 6),
            torch.arange(9.0, 4, -1),
            torch.arange(31.0, 36),
            torch.arange(41.0, 46),
        ],
        1,
    )
    found = VotedBox()(made(method, batch, places, weights, differ), batch, method.object_model)
    torch.testing.assert_close(
        found, torch.tensor([[2.0, 8.0, 32.0, 42.0], [3.0, 7.0, 33.0, 43.0]])
    )
