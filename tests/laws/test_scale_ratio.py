"""The size that an object appears at is that of the inputs' error, and is not made up."""

import math

import pytest
import torch
from torch import Tensor

from posefilter.confidence.scale_ratio import ScaleRatio, measure_scale_ratio, pool_gains
from posefilter.geometry.pose import make_pose, transform
from posefilter.geometry.rotation import exp_so3
from posefilter.nets.coordinates import Cells, Coordinates
from posefilter.types import ObjectModel

RADIUS, GRID = 0.1, (10, 20)
HALF_TURN = torch.tensor([-1.0, -1.0, 1.0])  # about z
POSE = make_pose(exp_so3(torch.tensor([0.3, -0.2, 0.1])), torch.tensor([0.1, 0.0, 1.0]))[None]


def draw(count: int, seed: int = 0) -> Tensor:
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))


SURFACE = RADIUS * torch.nn.functional.normalize(draw(200), dim=1) * torch.tensor([1.0, 0.6, 0.4])
MODEL = ObjectModel("egg", SURFACE, torch.zeros(3), RADIUS, 2 * RADIUS, torch.eye(4)[None], SURFACE)


def look(
    stretch: Tensor, shown: int = 100, noise: float = 0.03, told: Tensor | None = None
) -> tuple[Coordinates, Cells]:
    """Return what a network says of `shown` cells whose measured points are stretched by (3,).

    A cell has two fragments, as probable as each other: its own object point, and that of the
    object turned by half about z, as of an object that looks alike then.
    """
    points = transform(POSE, SURFACE[None])[0] * stretch
    told = SURFACE / RADIUS if told is None else told
    told = told + noise * draw(200, 1)
    place = torch.stack([told, told * HALF_TURN], dim=1)
    logit = torch.full((200,), -20.0)
    logit[:shown] = 5.0
    share = torch.full((1, *GRID, 2), math.log(0.5))
    seen = Coordinates(
        logit.view(1, *GRID),
        share,
        place.view(1, *GRID, 2, 3),
        torch.zeros(1, 2, 3),
        torch.zeros(1, *GRID, 0),
    )
    known = torch.ones(1, *GRID, dtype=torch.bool)
    return seen, Cells(points.view(1, *GRID, 3), known, torch.zeros(1, *GRID, 2))


def measure(seen: tuple[Coordinates, Cells], stretch: Tensor | None = None) -> ScaleRatio:
    """Measure from a pose whose center went with the measured points."""
    pose = POSE.clone()
    pose[:, :3, 3] *= torch.ones(3) if stretch is None else stretch
    return measure_scale_ratio(pose, *seen, MODEL)


@pytest.mark.parametrize("factor", [0.7, 0.8, 1.0, 1.25, 1.5])
def test_a_wrong_depth_scale_is_measured(factor: float) -> None:
    stretch = torch.full((3,), factor)
    found = measure(look(stretch), stretch)
    assert float(found.scale) == pytest.approx(factor, rel=0.04)  # the grid's step is 3.5 %
    assert float(found.explained) > 0.9
    assert bool(found.contradicts()) == (factor != 1.0)


@pytest.mark.parametrize("factor", [0.67, 1.5])
def test_a_wrong_focal_length_shows(factor: float) -> None:
    """It stretches what lies across the view, and not along."""
    stretch = torch.tensor([1 / factor, 1 / factor, 1.0])
    found = measure(look(stretch), stretch)
    assert (float(found.scale) > 1.12) == (factor < 1)
    assert bool(found.contradicts())


def test_scale_one_is_exact_where_nothing_is_wrong() -> None:
    found = measure(look(torch.ones(3), noise=0.0))
    assert float(found.scale) == pytest.approx(1.0)
    assert float(found.gain) == 0.0


def test_too_few_cells_say_nothing() -> None:
    found = measure(look(torch.full((3,), 1.5), shown=7), torch.full((3,), 1.5))
    assert math.isnan(float(found.scale))
    assert not bool(found.contradicts())


def test_a_network_that_tells_of_nothing_there_is_contradicted_by_nothing() -> None:
    wrong = torch.nn.functional.normalize(draw(200, 5), dim=1)
    assert not bool(measure(look(torch.ones(3), told=wrong)).contradicts())


def test_a_batch_is_its_images() -> None:
    large, plain = look(torch.full((3,), 1.25)), look(torch.ones(3))
    both = (
        Coordinates(*(torch.cat(pair) for pair in zip(large[0], plain[0], strict=True))),
        Cells(*(torch.cat(pair) for pair in zip(large[1], plain[1], strict=True))),
    )
    together = measure_scale_ratio(POSE.expand(2, 4, 4), *both, MODEL)
    for i, one in enumerate((large, plain)):
        alone = measure(one)
        assert [float(x[i]) for x in together] == pytest.approx([float(x[0]) for x in alone])


def test_an_estimate_is_measured_once_by_each_output_of_a_network() -> None:
    pose, seen, other = POSE.clone(), look(torch.ones(3)), look(torch.full((3,), 1.25))
    first = measure_scale_ratio(pose, *seen, MODEL)
    assert measure_scale_ratio(pose, *seen, MODEL) is first
    changed = measure_scale_ratio(pose, *other, MODEL)
    assert float(changed.scale) != float(first.scale)
    fewer = seen[1]._replace(valid=seen[1].valid & False)
    assert math.isnan(float(measure_scale_ratio(pose, seen[0], fewer, MODEL).scale))
    again = measure_scale_ratio(POSE.clone(), *seen, MODEL)
    assert again is not first
    assert torch.equal(again.scale, first.scale)


def test_objects_of_one_image_that_agree_on_a_scale_decide_together() -> None:
    """None of the first two contradicts the inputs by itself."""
    ratios = [
        ScaleRatio(*torch.tensor([[scale], [gain], [explained]]))
        for scale, gain, explained in (
            (1.25, 5.0, 0.9),
            (1.22, 6.0, 0.9),
            (1.0, 0.0, 0.9),  # appears in its size
            (math.nan, 0.0, 0.0),  # shows too little
            (1.25, 30.0, 0.9),  # is not there
            (1.25, 30.0, 0.3),  # is not where the network puts it
            (0.8, 6.0, 0.9),  # of another scale
        )
    ]
    there = [torch.tensor([i != 4]) for i in range(len(ratios))]
    pooled = pool_gains(ratios, there)
    assert [float(one.gain) for one in pooled] == [11, 11, 0, 0, 41, 41, 6]
    assert [bool(one.contradicts()) for one in ratios[:2]] == [False, False]
    assert [bool(one.contradicts()) for one in pooled[:4]] == [True, True, False, False]
    assert not pooled[6].contradicts()
