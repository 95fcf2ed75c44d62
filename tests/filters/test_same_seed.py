"""What is random comes of the generator alone, and keeps the precision of the states."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tests.models.toy import scenes, square
from torch import Generator, Tensor

from posefilter.filters.candidates import PersistentParticles, sample_around_truth
from posefilter.filters.initialize import FromObjectness, Informed, UniformPixels
from posefilter.filters.propagate import AxisRotations, Gaussian, HalfTurnRotations
from posefilter.filters.refine import MeanShift
from posefilter.filters.resample_move import ResampleMove
from posefilter.geometry.pose import make_pose, rotation_of
from posefilter.geometry.rotation import random_rotation
from posefilter.geometry.spaces import PixelSpace, PoseSpace
from posefilter.types import BeliefBatch, Step

SPACE = PoseSpace((0.01, 0.0, -0.02), 0.1)
COUNT = 12


def poses(dtype: torch.dtype = torch.float64) -> Tensor:
    g = Generator().manual_seed(9)
    turns = random_rotation(2, COUNT, generator=g)
    return make_pose(turns, torch.randn(2, COUNT, 3, generator=g)).to(dtype)


class Slope:
    space = SPACE

    def score_poses(
        self, encoding: None, poses: Tensor, sigma: float, generator: Generator, pixels: int
    ) -> Tensor:
        return 100 * poses[..., 0, 3]


class Map:
    def __init__(self, objectness: Tensor) -> None:
        self.objectness = objectness


class Pixels:
    space = PixelSpace()


def moved_by(kernel: Any) -> Callable[[Generator], Tensor]:
    state = poses()
    still, step = state.new_zeros(2, COUNT, 6), Step(0, 1, state.new_tensor(0.02))
    return lambda g: kernel(state, still, step, SPACE, g)


def refined_by(refine: Any, part: str) -> Callable[[Generator], Tensor]:
    even = torch.randn(2, COUNT, generator=Generator().manual_seed(1)).double().log_softmax(1)
    belief = BeliefBatch(poses(), even, poses()[:, 0], torch.zeros(2).double())
    return lambda g: getattr(refine(belief, None, Slope(), g), part)


def started_by(piece: Any) -> Callable[[Generator], Tensor]:
    batch, encoding = scenes(1), Map(torch.rand(1, 1, 5, 10, generator=Generator().manual_seed(0)))
    return lambda g: piece(batch, encoding, Pixels(), 30, g)


def candidates(g: Generator) -> Tensor:
    space = PoseSpace((0.0, 0.0, 0.0), square().radius)
    return sample_around_truth(
        scenes(2), square(), space, 4, (0.01, 0.1), g, HalfTurnRotations(0.5)
    )


def advanced(g: Generator) -> Tensor:
    batch, kept = scenes(1), PersistentParticles(6)
    used, sigma = torch.tensor([True]), torch.tensor([0.0])  # what is drawn are the ancestors alone
    start = poses(torch.float32)[:1]
    kept.advance(batch, start, torch.zeros(1, COUNT), sigma, used, SPACE, g)
    return kept.state()["poses"]


@pytest.mark.parametrize(
    "draw",
    [
        moved_by(Gaussian(0.5)),
        moved_by(HalfTurnRotations(0.5)),
        moved_by(AxisRotations(0.5, 0.5)),
        refined_by(MeanShift(2, 3), "best"),
        refined_by(ResampleMove(4, rotation_probability=0.5), "poses"),
        started_by(UniformPixels()),
        started_by(FromObjectness()),
        started_by(Informed(UniformPixels()).train()),
        candidates,
        advanced,
    ],
    ids=lambda draw: draw.__qualname__.split(".")[0],
)
def test_the_seed_decides(draw: Callable[[Generator], Tensor]) -> None:
    one, same, other = (draw(Generator().manual_seed(seed)) for seed in (3, 3, 4))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


@pytest.mark.parametrize(
    ("kernel", "error"), [(HalfTurnRotations(1.0), 1e-9), (AxisRotations(1.0, 0.0), 1e-6)]
)
def test_half_a_turn_of_double_precision_is_half_a_turn(kernel: Any, error: float) -> None:
    state = torch.eye(4).double().expand(1, COUNT, 4, 4)
    still, step = state.new_zeros(1, COUNT, 6), Step(0, 1, state.new_tensor(0.02))
    R = rotation_of(kernel(state, still, step, SPACE, Generator().manual_seed(0)))
    assert R.dtype == torch.float64
    torch.testing.assert_close(R @ R, torch.eye(3).double().expand_as(R), atol=error, rtol=0)
    torch.testing.assert_close(R.diagonal(dim1=-2, dim2=-1).sum(-1), -torch.ones(1, COUNT).double())


def test_any_angle_is_as_likely_in_either_direction() -> None:
    """A uniform angle has a mean sine of 0, and no angle is likelier than its opposite."""
    state = torch.eye(4).double().expand(1, 20_000, 4, 4)
    step = Step(0, 1, state.new_tensor(0.02))
    turned = AxisRotations(1.0, 1.0)(
        state, state.new_zeros(1, 20_000, 6), step, SPACE, Generator().manual_seed(0)
    )
    skew = rotation_of(turned) - rotation_of(turned).mT  # sines of the angle, of one axis each
    sines = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1).sum(-1) / 2
    assert abs(float(sines.mean())) < 5 * 0.5**0.5 / 20_000**0.5
