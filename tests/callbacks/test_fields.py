"""The likelihood field: its top lies where the truth is, for a likelihood that knows it."""

import math

import numpy as np
import pytest
import torch
from torch import Generator, Tensor

from posefilter.callbacks.fields import (
    choose_levels,
    choose_pixels,
    evaluate_point_field,
    evaluate_pose_field,
    make_point,
    shift_pose,
    turn_pose,
)
from posefilter.figures.canvas import TRUTH
from posefilter.figures.field import color_scores, draw_point_field, draw_pose_field, round_down
from posefilter.figures.layout import WIDTH
from posefilter.geometry.camera import intrinsics
from posefilter.geometry.pose import invert, make_pose, origin_of, transform
from posefilter.geometry.rotation import exp_so3
from posefilter.geometry.spaces import PoseSpace
from posefilter.nets.coordinates import Coordinates
from posefilter.nets.likelihood import Points, PoseLikelihood, flatten_images
from posefilter.nets.paper_likelihood import PaperLikelihood
from posefilter.types import Batch, ObjectModel, Step

H, W = 48, 64
CENTER = torch.tensor([0.01, -0.02, 0.03])
TRUE = make_pose(exp_so3(torch.tensor([0.4, -0.3, 0.9])), torch.tensor([0.02, 0.01, 0.8]))


def model() -> ObjectModel:
    hull = CENTER + torch.tensor(
        [[x, y, z] for x in (-0.05, 0.05) for y in (-0.08, 0.08) for z in (-0.1, 0.1)]
    )
    return ObjectModel("box", hull, CENTER, 0.14, 0.28, torch.eye(4)[None], hull)


def scene() -> Batch:
    """A wall at 0.8 m, on which a part counts as the object."""
    mask = torch.zeros(1, 1, H, W, dtype=torch.bool)
    mask[..., 16:34, 24:44] = True
    K = intrinsics(60.0, 60.0, (W - 1) / 2, (H - 1) / 2)[None]
    depth = torch.full((1, 1, H, W), 0.8)
    depth[..., :6, :] = 0
    zero, one = torch.zeros(1, dtype=torch.int64), torch.ones(1)
    return Batch(torch.full((1, 3, H, W), 0.5), depth, mask, K, TRUE[None], zero, zero, one)


class Oracle:
    """Scores poses by their distance from one that it is told."""

    def __init__(self, truth: Tensor) -> None:
        self.truth, self.space = truth, PoseSpace(tuple(CENTER.tolist()), 0.14)

    def score_poses(
        self, encoding: object, poses: Tensor, sigma: float, generator: Generator, pixels: int
    ) -> Tensor:
        return -0.5 * (self.space.distance(poses, self.truth) / sigma).square()


def test_slices_of_an_oracle_have_their_top_at_the_truth_and_its_exact_shape() -> None:
    field = evaluate_pose_field(Oracle(TRUE), None, TRUE, model(), (0.04, 0.01), cells=9)
    assert field.extents == pytest.approx((0.24, 0.06))
    for k, sigma in enumerate(field.sigmas):
        line = np.linspace(-field.extents[k], field.extents[k], 9)
        exact = -0.5 * (line[None, :] ** 2 + line[:, None] ** 2) / sigma**2
        for values in field.planes[k]:
            assert np.unravel_index(values.argmax(), values.shape) == (4, 4)
            assert values == pytest.approx(exact, abs=2e-3 * abs(exact.min()))
        for values in field.turns[k]:
            assert field.degrees[values.argmax()] == 0
            assert values == pytest.approx(
                -0.5 * (np.deg2rad(field.degrees) * 0.14 / sigma) ** 2, rel=2e-3, abs=2e-3
            )


def test_an_oracle_of_a_shifted_pose_has_its_maximum_there() -> None:
    wrong = TRUE @ make_pose(torch.eye(3), torch.tensor([0.0, 0.03, -0.03]))
    # 15 mm a cell
    field = evaluate_pose_field(Oracle(wrong), None, TRUE, model(), (0.01,), cells=9)
    assert np.unravel_index(field.planes[0, 2].argmax(), (9, 9)) == (2, 6)  # rows z, columns y
    # it outscores the truth, and that is told
    assert field.planes[0, 2].max() == pytest.approx(0.5 * 18, rel=1e-2)


def test_shifts_are_along_the_objects_axes_and_turns_about_its_center() -> None:
    poses = shift_pose(TRUE, 0.1, 3)
    # plane x-z
    moved = transform(invert(TRUE), origin_of(poses[1, 2, 0], CENTER)[None])[0] - CENTER
    assert moved.tolist() == pytest.approx([-0.1, 0.0, 0.1], abs=1e-6)
    poses = turn_pose(TRUE, CENTER, torch.tensor([0.5]))
    assert (origin_of(poses, CENTER) - origin_of(TRUE, CENTER)).abs().max() < 1e-6
    turn = TRUE[:3, :3].T @ poses[2, 0, :3, :3]
    assert turn[0, 0] == pytest.approx(math.cos(0.5), abs=1e-6)
    assert turn[2].tolist() == pytest.approx([0, 0, 1], abs=1e-6)


def test_levels_are_the_ends_and_the_middle() -> None:
    steps = [Step(t, 5, torch.tensor(s)) for t, s in enumerate((0.04, 0.03, 0.02, 0.01, 0.005))]
    assert choose_levels(steps) == pytest.approx((0.04, 0.02, 0.005))
    assert choose_levels(steps[:1] * 3) == pytest.approx((0.04,))


class Knows(PoseLikelihood):
    """Judges a point by how far it lies from a place."""

    place = torch.tensor([0.03, -0.01, 0.02])

    def score_at_level(self, points: Points, level: Tensor, radius: float) -> Tensor:
        return 1 - (points.position - self.place).norm(dim=-1) / radius


def test_a_pixel_is_read_where_it_is() -> None:
    batch, image = scene(), flatten_images(scene().rgb, scene().depth, scene().intrinsics)
    points = make_point((40, 30), image, TRUE, model())
    camera = torch.tensor([(40 - 31.5) / 60 * 0.8, (30 - 23.5) / 60 * 0.8, 0.8])
    assert bool(points.inside.all())
    expected = transform(invert(batch.camera_from_object), camera[None, None])[0, 0] - CENTER
    assert points.position.flatten().tolist() == pytest.approx(expected.tolist(), abs=1e-6)


@pytest.mark.parametrize("depthwise", [False, True])
def test_slices_for_a_point_are_highest_where_the_likelihood_is(
    depthwise: bool,
) -> None:
    image = flatten_images(scene().rgb, scene().depth, scene().intrinsics)
    field = evaluate_point_field(
        Knows(), image, TRUE, model(), (40, 30), True, (0.04, 0.004), depthwise
    )
    a, b = field.plane
    row, column = np.unravel_index(field.scores[0].argmax(), field.scores[0].shape)
    line = np.linspace(-field.extent, field.extent, field.scores.shape[1])
    assert abs(line[column] - float(Knows.place[a])) < line[1] - line[0]
    assert abs(line[row] - float(Knows.place[b])) < line[1] - line[0]
    assert field.own[0] == pytest.approx(
        1 - np.linalg.norm(field.place - Knows.place.numpy()) / 0.14, abs=1e-5
    )
    ray = TRUE[:3, :3].T @ torch.tensor([(40 - 31.5) / 60, (30 - 23.5) / 60, 1.0])
    assert (int(ray.abs().argmax()) in field.plane) == depthwise


def test_the_papers_likelihood_has_a_field_too() -> None:
    image = flatten_images(scene().rgb, scene().depth, scene().intrinsics)
    with torch.no_grad():
        field = evaluate_point_field(
            PaperLikelihood(), image, TRUE, model(), (40, 30), True, (0.04,)
        )
    assert np.isfinite(field.scores).all()
    assert field.scores.std() > 0


def test_pixels_are_chosen_well_on_the_object_and_near_it() -> None:
    (on, is_on), (off, is_off) = choose_pixels(scene(), model())
    assert (is_on, is_off) == (True, False)
    assert 30 <= on[0] <= 37  # the middle of the mask, columns 24 to 43 and rows 16 to 33
    assert 22 <= on[1] <= 28
    assert not bool(scene().mask[0, 0, off[1], off[0]])
    assert off[1] >= 6  # where depth is known
    assert (
        choose_pixels(scene()._replace(mask=torch.zeros(1, 1, H, W, dtype=torch.bool)), model())
        == []
    )


def test_picture_of_poses_is_brightest_at_the_truth_and_black_where_that_is_outscored() -> None:
    values = -np.ones((9, 9))
    values[4, 4], values[1, 7] = 0.0, 0.5
    cells = color_scores(values, -1.0)
    size = len(cells)
    assert cells[size // 2, size // 2].astype(int).sum() > cells[0, 0].astype(int).sum() + 200
    assert (cells[size // 8, size * 7 // 8] < 20).all()
    field = evaluate_pose_field(Oracle(TRUE), None, TRUE, model(), (0.04, 0.01), cells=9)
    picture = draw_pose_field(field, "title", np.array([0.02, 0.0, 0.0]))
    assert picture.shape[1] == WIDTH
    assert (picture == TRUTH).all(-1).sum() > 300  # a ring in each of six slices


def test_picture_of_points_shows_each_slice() -> None:
    image = flatten_images(scene().rgb, scene().depth, scene().intrinsics)
    fields = [
        evaluate_point_field(Knows(), image, TRUE, model(), (40, 30), True, (0.04, 0.004), d)
        for d in (False, True)
    ]
    picture = draw_point_field(
        fields, np.full((H, W, 3), 128, np.uint8), (model().points - CENTER).numpy(), "title"
    )
    red = (picture[..., 0] > 120) & (picture[..., 1] < 60) & (picture[..., 2] < 80)
    assert red.sum() > 200  # the favored places


def test_ticks_are_round() -> None:
    assert [round_down(x) for x in (72.0, 216.0, -6.7, 0.0, 1.0, 0.034)] == [
        70,
        200,
        -6,
        0,
        1,
        pytest.approx(0.03),
    ]


def test_context_is_queried_at_the_hypothesis_not_at_the_pixel() -> None:
    class Told(PoseLikelihood):
        def score_at_level(self, points: Points, level: Tensor, radius: float) -> Tensor:
            assert points.context is not None
            return points.context[..., 0]  # log of the share of the fragment there

    # two halves, along the object's x
    centers = torch.tensor([[[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]]])
    share = torch.tensor([0.9, 0.1]).log().expand(1, 6, 8, 2)
    said = Coordinates(
        torch.zeros(1, 6, 8), share, torch.zeros(1, 6, 8, 2, 3), centers, torch.zeros(1, 6, 8, 4)
    )
    image = flatten_images(scene().rgb, scene().depth, scene().intrinsics, said)
    field = evaluate_point_field(
        Told(), image, TRUE, model(), (40, 30), True, (0.04,), depthwise=True
    )
    assert 0 in field.plane
    # columns go along the plane's first axis
    along_x = field.scores[0].mean(0 if field.plane[0] == 0 else 1)
    assert along_x[:13] == pytest.approx(math.log(0.9), abs=1e-3)
    assert along_x[-13:] == pytest.approx(math.log(0.1), abs=1e-3)
