"""Witnesses count what they are named for."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from posefilter.confidence.calibration import LIMIT, standardize
from posefilter.confidence.features import (
    measure_belief,
    measure_coordinates,
    measure_depth,
    measure_hidden,
)
from posefilter.geometry.pose import make_pose, transform
from posefilter.geometry.rotation import exp_so3
from posefilter.nets.coordinates import Cells, Coordinates
from posefilter.types import BeliefBatch, ObjectModel

RADIUS = 0.1


def sphere(count: int = 200) -> torch.Tensor:
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return RADIUS * points / points.norm(dim=1, keepdim=True)


MODEL = ObjectModel(
    "ball", sphere(), torch.zeros(3), RADIUS, 2 * RADIUS, torch.eye(4)[None], sphere()
)


def look(error: float, member: float, beside: int = 0) -> dict[str, float]:
    """Return the witnesses where 100 cells show the object.

    error: of the predicted object points, in radii; member: probability of membership that the
    network gives to the object's cells; beside: cells of the background that it takes for the
    object, with the same probability.
    """
    pose = make_pose(exp_so3(torch.tensor([0.3, -0.2, 0.1])), torch.tensor([0.1, 0.0, 1.0]))[None]
    on = sphere()[:100]
    off = torch.randn(100, 3, generator=torch.Generator().manual_seed(1)) * 0.05 + 1.0
    points = torch.cat([transform(pose, on[None])[0], off])[None].view(1, 10, 20, 3)
    shift = torch.zeros(200, 3)
    shift[:, 0] = error
    place = (torch.cat([on / RADIUS, off]) + shift).view(1, 10, 20, 1, 3)
    odds = math.log(member / (1 - member))
    logit = torch.full((200,), -20.0)
    logit[: 100 + beside] = odds
    share = torch.zeros(1, 10, 20, 1)
    nothing = torch.zeros(1, 10, 20, 0)
    seen = Coordinates(logit.view(1, 10, 20), share, place, torch.zeros(1, 1, 3), nothing)
    cells = Cells(points, torch.ones(1, 10, 20, dtype=torch.bool), torch.zeros(1, 10, 20, 2))
    found = measure_coordinates(pose, seen, cells, MODEL)
    return {name: float(value) for name, value in found.items()}


def test_predicted_points_count_within_a_fifth_of_the_radius() -> None:
    assert look(0.15, 0.99)["coordinates"] > 0.99
    assert look(0.25, 0.99)["coordinates"] < 0.01


def test_what_lies_beside_the_pose_speaks_against_it_where_it_should() -> None:
    alone, more = look(0.05, 0.9), look(0.05, 0.9, beside=50)
    assert more["mask_precision"] < alone["mask_precision"] - 0.3
    for name in ("mask_recall", "top_objectness"):
        assert abs(more[name] - alone[name]) < 0.01


def test_cells_that_the_network_does_not_recognize_are_told_by_their_share() -> None:
    assert abs(look(0.05, 0.3)["mask_recall"] - 0.3) < 0.01
    assert abs(look(0.05, 0.3)["top_objectness"] - 0.3) < 0.01


@pytest.mark.parametrize(("wall", "free"), [(0.5, 0.5), (1.6, 1 / 202), (0.0, 0.5)])
def test_what_is_seen_through_speaks_against_a_pose_and_what_hides_it_says_nothing(
    wall: float, free: float
) -> None:
    K = torch.tensor([[100.0, 0, 31.5], [0, 100.0, 23.5], [0, 0, 1]])
    pose = torch.eye(4)[None].clone()
    pose[0, 2, 3] = 1.0
    seen: Any = SimpleNamespace(depth=torch.full((1, 1, 48, 64), wall), intrinsics=K[None])
    found = measure_depth(pose, seen, MODEL)
    assert float(found["surface"]) == 0
    assert float(found["free_space"]) == pytest.approx(free, abs=1e-3)


@pytest.mark.parametrize(
    ("wall", "columns", "hidden"),
    [(0.5, 64, 1.0), (1.6, 64, 0.0), (0.5, 32, 0.5), (1.0, 64, 0.5)],
)
def test_what_is_measured_before_a_pose_hides_it(wall: float, columns: int, hidden: float) -> None:
    """`wall` [m] covers the left columns; in the others what lies behind is measured."""
    K = torch.tensor([[100.0, 0, 31.5], [0, 100.0, 23.5], [0, 0, 1]])
    pose = torch.eye(4)[None].clone()
    pose[0, 2, 3] = 1.0
    depth = torch.full((1, 1, 48, 64), 1.6)
    depth[..., :columns] = wall
    seen: Any = SimpleNamespace(depth=depth, intrinsics=K[None])
    assert float(measure_hidden(pose, seen, MODEL)) == pytest.approx(hidden, abs=0.05)
    # of unknown depth nothing can be said
    blank: Any = SimpleNamespace(depth=torch.zeros_like(depth), intrinsics=K[None])
    assert float(measure_hidden(pose, blank, MODEL)) == 0


def test_particles_at_equivalent_poses_agree() -> None:
    half = make_pose(exp_so3(torch.tensor([0.0, 0.0, math.pi])), torch.zeros(3))
    turns = exp_so3(torch.arange(36)[:, None] * torch.tensor([0.0, 0.0, 2 * math.pi / 36]))
    round_ = make_pose(turns, torch.zeros(36, 3))
    best = make_pose(exp_so3(torch.tensor([0.3, -0.2, 0.1])), torch.tensor([0.1, 0.0, 1.0]))
    generator = torch.Generator().manual_seed(0)
    near = make_pose(exp_so3(0.02 * torch.randn(50, 3, generator=generator)), torch.zeros(50, 3))
    between = make_pose(exp_so3(torch.tensor([0.0, 0.0, 0.05])), torch.zeros(3))

    def measure(symmetries: torch.Tensor, turn: torch.Tensor) -> dict[str, torch.Tensor]:
        own = best @ near
        own = torch.cat([own[:25], own[25:] @ turn])
        belief = BeliefBatch(own[None], torch.full((1, 50), 0.02).log(), best[None], torch.ones(1))
        return measure_belief(belief, MODEL._replace(symmetries=symmetries))

    eye = torch.eye(4)
    alone, apart = (measure(eye[None], turn)["concentration"] for turn in (eye, half))
    assert float(alone) > 4 > 0 > float(apart)
    pair = measure(torch.stack([eye, half]), half)
    assert "concentration" not in pair
    assert float(pair["concentration_up_to_symmetry"]) == pytest.approx(float(alone), abs=1e-3)
    # a continuous symmetry is known by a few of its turns
    any_turn = measure(round_, half @ between)["concentration_up_to_symmetry"]
    assert float(any_turn) >= float(alone)


def test_what_is_no_number_speaks_against_an_estimate_as_far_as_any_can() -> None:
    features = np.array([[np.inf, -np.inf, np.nan, 1.0]])
    standardized = standardize(features, (0.0,) * 4, (1.0,) * 4)
    assert standardized.tolist() == [[-LIMIT, -LIMIT, -LIMIT, 1.0]]
