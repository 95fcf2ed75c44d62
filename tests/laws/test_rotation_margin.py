"""The texture's margin says how clearly the image decides between rotations of a shape."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from posefilter.confidence.features import measure_print
from posefilter.confidence.rotation_margin import Rivals, list_rivals, measure_rotation_margin
from posefilter.filters.texture import coarsen_texture, measure_texture
from posefilter.geometry.pose import make_pose, transform
from posefilter.geometry.rotation import random_rotation
from posefilter.types import Batch, ObjectModel
from printed_objects import Seen, load, look


def place(model: ObjectModel, seed: int = 5) -> Tensor:
    rotation = random_rotation(1, generator=torch.Generator().manual_seed(seed))[0]
    shift = torch.tensor([0.0, 0, 4.5 * model.radius])
    return make_pose(rotation, shift - rotation @ model.center)


def rivals_of(model: ObjectModel) -> Rivals:
    found = list_rivals(model)
    assert found is not None
    return found


def margin(pose: Tensor, image: Seen, model: ObjectModel) -> float:
    evidence = measure_texture(pose[None, None], image, coarsen_texture(model))[:, 0]
    found = measure_rotation_margin(pose[None], image, model, evidence)
    assert found is not None
    return float(found)


@pytest.mark.parametrize("name", ["carton", "soup_can"])
def test_it_is_above_zero_at_the_true_pose_and_below_at_a_rotated_one(name: str) -> None:
    model = load(name)
    pose, turns = place(model), rivals_of(model).turns
    image = look(name, pose)
    assert margin(pose, image, model) > 1
    for turn in turns[:: max(1, len(turns) // 3)]:
        assert margin(pose @ turn, image, model) < -1


def test_of_few_rotations_it_is_the_exact_difference_to_the_best() -> None:
    model = load("carton")
    pose = place(model, 7)
    image, turns = look("carton", pose), rivals_of(model).turns
    assert len(turns) == 3
    poses = torch.cat([pose[None], pose @ turns])
    evidence = measure_texture(poses[None], image, coarsen_texture(model))[0]
    difference = float(evidence[0] - evidence[1:].max())
    assert difference > 0
    assert margin(pose, image, model) == pytest.approx(math.log1p(difference), rel=1e-4)


def test_of_a_can_a_search_of_some_rotations_finds_the_best_of_all() -> None:
    model = load("soup_can")
    pose = place(model)
    image, turns = look("soup_can", pose), rivals_of(model).turns
    every = measure_texture(pose @ turns[None], image, coarsen_texture(model))[0].max()
    zero = torch.zeros(1)
    found = measure_rotation_margin(pose[None], image, model, zero)
    assert found is not None
    assert float(every) > 1
    assert float((-found).expm1()) > 0.8 * float(every)


def test_rivals_make_a_right_pose_wrong_and_rotations_that_change_nothing_are_none() -> None:
    model = load("soup_can")
    rivals = rivals_of(model)
    moved = transform(rivals.turns, model.points.expand(len(rivals.turns), -1, -1)) - model.points
    assert float(moved.norm(dim=-1).mean(-1).min()) > 0.09 * model.diameter
    assert set(rivals.first.tolist()) <= set(range(len(rivals.turns)))
    assert model.shape_symmetries is not None
    same = model._replace(symmetries=model.shape_symmetries)
    assert list_rivals(same) is None
    image = look("soup_can", pose := place(model))
    assert measure_rotation_margin(pose[None], image, same, torch.ones(1)) is None
    old = model._replace(shape_symmetries=None)  # as earlier versions wrote it
    assert measure_rotation_margin(pose[None], image, old, torch.ones(1)) is None


def test_a_print_is_dense_where_little_surface_shows_it_and_a_known_margin_is_kept() -> None:
    model = load("carton")
    pose = place(model)
    image = look("carton", pose)
    seen = Batch(
        rgb=image.measured_color,
        depth=image.measured_depth[:, None],
        intrinsics=image.intrinsics,
        mask=image.measured_depth[:, None],
        camera_from_object=pose[None],
        object_id=torch.zeros(1, dtype=torch.int64),
        frame_id=torch.zeros(1, dtype=torch.int64),
        visibility=torch.ones(1),
    )
    much, little = (
        measure_print(pose[None], seen, model, torch.tensor([surface])) for surface in (0.475, 0.1)
    )
    assert float(much["texture"]) > 1
    assert torch.equal(much["texture"], little["texture"])
    gained = float(little["texture_density"] - much["texture_density"])
    assert gained == pytest.approx(math.log(4), abs=1e-5)
    assert float(much["rotation_margin"]) == pytest.approx(margin(pose, image, model), abs=1e-5)
    known = measure_print(pose[None], seen, model, torch.tensor([0.1]), torch.tensor([-3.0]))
    assert float(known["rotation_margin"]) == -3
    plain = measure_print(pose[None], seen, model._replace(texture=None), torch.tensor([0.1]))
    assert plain == {}


@pytest.mark.parametrize("name", ["carton", "soup_can"])
def test_the_learned_likelihood_counts_as_much_as_the_texture(name: str) -> None:
    model, by = load(name), 1000.0
    pose, rivals = place(model), rivals_of(model)
    image = look(name, pose)
    evidence = measure_texture(pose[None, None], image, coarsen_texture(model))[:, 0]

    def measure(score: Callable[[Tensor], Tensor]) -> float:
        found = measure_rotation_margin(pose[None], image, model, evidence, score)
        assert found is not None
        return float(found)

    def favor(one: Tensor) -> Callable[[Tensor], Tensor]:
        return lambda poses: by * ((poses - one).flatten(-2).norm(dim=-1) < 1e-4)

    alone = margin(pose, image, model)
    same = measure(lambda poses: poses.new_full(poses.shape[:2], 7.0))
    assert same == pytest.approx(alone, abs=1e-4)
    other = pose @ rivals.turns[rivals.first[len(rivals.first) // 2]]
    assert -math.log1p(by) < measure(favor(other)) < -math.log1p(by / 2)
    more = math.log1p(math.expm1(alone) + by)
    assert measure(favor(pose)) == pytest.approx(more, rel=1e-3)
