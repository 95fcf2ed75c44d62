"""The loss over crops and rotations: nothing where the posterior is right, and symmetric poses are
right.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from posefilter.geometry.crops import look_at
from posefilter.geometry.pose import make_pose, pose_about
from posefilter.geometry.rotation import exp_so3, spread_rotations
from posefilter.geometry.spaces import PoseSpace
from posefilter.losses.grid_posterior import GridPosterior, squared_distances


class Encoding(NamedTuple):
    """Scores of crops and rotations."""

    scores: Tensor
    centers: Tensor
    rotations: Tensor


G = torch.Generator().manual_seed(0)
CENTERS = torch.tensor([0.2, 0.1, 1.0], dtype=torch.float64) + 0.1 * torch.randn(
    1, 5, 3, generator=G
)
CELLS = spread_rotations(40).double()


def loss_of(scores: Tensor, batch, model, make_trace, sigma: float = 0.3) -> float:
    trace = make_trace(torch.zeros(1, 1, 2))._replace(encoding=Encoding(scores, CENTERS, CELLS))
    return float(GridPosterior(sigma)(trace, batch, model))


def test_distances_are_those_of_the_poses(batch, model) -> None:
    model = model._replace(center=torch.tensor([0.02, 0.0, -0.01], dtype=torch.float64))
    found = squared_distances(CENTERS, CELLS, batch.camera_from_object, model).sqrt()
    R = look_at(CENTERS)[:, :, None] @ CELLS
    poses = pose_about(R, CENTERS[:, :, None], model.center)
    space = PoseSpace(tuple(model.center.tolist()), model.radius)
    torch.testing.assert_close(
        found, space.distance(poses, batch.camera_from_object), atol=1e-6, rtol=0
    )


def test_a_gaussian_about_the_truth_costs_nothing_and_all_else_its_divergence(
    batch, model, make_trace
) -> None:
    far = squared_distances(CENTERS, CELLS, batch.camera_from_object, model)
    right = -0.5 * far / (0.3 * model.radius) ** 2
    assert abs(loss_of(right + 7, batch, model, make_trace)) < 1e-9
    flat = loss_of(torch.zeros_like(right), batch, model, make_trace)
    share = right.flatten().softmax(0)
    entropy = float(torch.special.entr(share).sum())
    assert math.isclose(flat, math.log(200) - entropy, rel_tol=1e-6)


def test_a_symmetry_about_another_point_than_the_center_moves_it(batch, model) -> None:
    """As of a prism of three sides, whose box's center is not on its axis."""
    turn = exp_so3(torch.tensor([0.0, 0.0, 2 * math.pi / 3], dtype=torch.float64))
    third = make_pose(turn, torch.zeros(3, dtype=torch.float64))
    center = torch.tensor([0.03, 0.0, 0.0], dtype=torch.float64)
    model = model._replace(
        center=center, symmetries=torch.stack([torch.eye(4).double(), third, third @ third])
    )
    equal = batch.camera_from_object[0] @ third
    place = equal[:3, :3] @ center + equal[:3, 3]
    rotation = look_at(place[None, None])[0, 0].mT @ equal[:3, :3]
    far = squared_distances(place[None, None], rotation[None], batch.camera_from_object[:1], model)
    assert float(far) < 1e-12


def test_an_image_without_the_object_teaches_nothing(batch, model, make_trace) -> None:
    scores = torch.randn(1, 5, 40, generator=G, dtype=torch.float64)
    away = batch._replace(mask=torch.zeros_like(batch.mask))
    assert loss_of(scores, away, model, make_trace) == 0 < loss_of(scores, batch, model, make_trace)


def test_a_pose_that_a_symmetry_makes_equal_is_as_right(batch, model, make_trace) -> None:
    turn = exp_so3(torch.tensor([0.0, 0.0, math.pi], dtype=torch.float64))
    half = make_pose(turn, torch.zeros(3, dtype=torch.float64))
    twofold = model._replace(symmetries=torch.stack([torch.eye(4).double(), half]))
    turned = batch._replace(camera_from_object=batch.camera_from_object @ half)
    scores = torch.randn(1, 5, 40, generator=G, dtype=torch.float64)
    a, b = (loss_of(scores, one, twofold, make_trace) for one in (batch, turned))
    assert math.isclose(a, b, rel_tol=1e-9)
    assert not math.isclose(
        loss_of(scores, batch, model, make_trace), loss_of(scores, turned, model, make_trace),
        rel_tol=1e-3,
    )  # fmt: skip
