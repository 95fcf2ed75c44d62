"""Areas, recalls and medians by hand; boxes; and what the collecting classes make of misses and
batches.
"""

import math

import numpy as np
import pytest
import torch

from posefilter.errors import UserError
from posefilter.geometry.boxes import box_iou, box_of_pose
from posefilter.geometry.camera import intrinsics
from posefilter.geometry.pose import make_pose
from posefilter.metrics.collect import BoxIoU, ParticlesOnObject, PoseErrors
from posefilter.metrics.scores import auc, median, recall, summarize
from posefilter.types import ObjectModel

POINTS = torch.tensor([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)])
MODEL = ObjectModel("cube", POINTS, torch.zeros(3), 0.1732, 0.3464, torch.eye(4)[None], POINTS)


def shifted(*distances: float) -> torch.Tensor:
    return make_pose(torch.eye(3), torch.tensor([[d, 0.0, 1.0] for d in distances]))


def voc(errors: list[float]) -> float:
    """The toolbox's steps, one by one: d(d > 0.1) = inf; sort; accuracy; VOCap with a monotone
    precision; times ten.
    """
    d = np.sort([e if e <= 0.1 else math.inf for e in errors])
    accuracy = np.arange(1, len(d) + 1) / len(d)
    keep = d < 0.1
    if not keep.any():
        return 0.0
    rec, prec = [0.0, *d[keep], 0.1], [0.0, *accuracy[keep], accuracy[keep][-1]]
    for i in range(1, len(prec)):
        prec[i] = max(prec[i], prec[i - 1])
    return (
        100
        * 10
        * sum((rec[i] - rec[i - 1]) * prec[i] for i in range(1, len(rec)) if rec[i] != rec[i - 1])
    )


def test_the_area_is_the_toolboxs() -> None:
    g = torch.Generator().manual_seed(0)
    for scale in (0.01, 0.05, 0.3):
        errors = scale * torch.rand(57, generator=g).double() ** 2
        errors[:5] = math.inf
        assert auc(errors) == pytest.approx(voc(errors.tolist()), abs=1e-9)
    # By the right endpoint: at the first of two errors, 0.02, accuracy 1/2 counts from 0 on.
    assert auc(torch.tensor([0.02, 0.06]).double()) == pytest.approx(
        100 * (0.02 * 0.5 + 0.04 + 0.04) / 0.1
    )
    assert auc(torch.tensor([0.02, math.inf]).double()) == pytest.approx(50)


def test_both_ends() -> None:
    assert auc(torch.zeros(4)) == pytest.approx(100)
    assert auc(torch.full((4,), math.inf)) == 0
    assert auc(torch.full((4,), 0.1)) == 0
    assert math.isnan(auc(torch.zeros(0)))
    assert math.isnan(median(torch.zeros(0)))


def test_recall_and_median() -> None:
    errors = torch.tensor([0.001, 0.015, 0.03, math.inf])
    assert recall(errors, 0.02) == 50
    assert recall(errors, torch.tensor([0.0001, 0.02, 0.04, 1.0])) == 50
    assert median(errors) == pytest.approx(0.0225)
    assert median(errors[[0, 3, 3]]) == math.inf
    with pytest.raises(UserError, match="NaN"):
        summarize(torch.tensor([math.nan]), 0.1)


def test_misses_count_as_infinitely_wrong() -> None:
    metric = PoseErrors([MODEL])
    truth = shifted(0, 0, 0, 0)
    guess = shifted(0.0, 0.005, 0.005, 0.05)
    guess[1, 0, 0] = math.nan
    guess[2] = math.nan
    metric.update(guess[:2], truth[:2])
    metric.update(guess[2:], truth[2:])
    found = metric.compute()
    assert (found["instances"], found["missed"]) == (4, 2)
    assert found["add"]["recall_2cm"] == 25
    assert found["add"]["recall_01d"] == 25  # 0.05 > 0.1 x 0.3464
    assert found["add"]["auc"] == pytest.approx(voc([0.0, math.inf, math.inf, 0.05]))


def test_each_object_has_its_own_points_and_diameter() -> None:
    large = MODEL._replace(points=POINTS * 2, diameter=0.6928)
    metric = PoseErrors([MODEL, large])
    truth = shifted(0, 0)
    metric.update(shifted(0.05, 0.05), truth, torch.tensor([0, 1]))
    assert metric.compute()["add"]["recall_01d"] == 50  # within 0.069, not within 0.035


def test_batches_do_not_matter() -> None:
    truth, guess = shifted(*[0.0] * 9), shifted(*np.linspace(0, 0.12, 9))
    whole, parts = PoseErrors([MODEL]), PoseErrors([MODEL])
    whole.update(guess, truth)
    for i in range(9):
        parts.update(guess[i : i + 1], truth[i : i + 1])
    assert whole.compute() == parts.compute()
    parts.reset()
    parts.update(guess[:1], truth[:1])
    assert parts.compute()["instances"] == 1


def test_boxes() -> None:
    K = intrinsics(100.0, 100.0, 49.5, 39.5)
    face = POINTS * torch.tensor([1.0, 1.0, 0.0])
    poses = make_pose(torch.eye(3), torch.tensor([[0.0, 0, 1], [0.4, 0, 1], [5, 0, 1], [0, 0, -1]]))
    boxes = box_of_pose(poses, face, K, 80, 100)
    expected = torch.tensor(
        [[39.5, 29.5, 59.5, 49.5], [79.5, 29.5, 99.5, 49.5], [0, 0, 0, 0], [0, 0, 0, 0]]
    )
    torch.testing.assert_close(boxes, expected)
    a = torch.tensor([[0.0, 0, 2, 2], [0, 0, 2, 2], [0, 0, 2, 2], [0, 0, 0, 0]])
    b = torch.tensor([[0.0, 0, 2, 2], [1, 1, 3, 3], [2, 0, 4, 2], [0, 0, 0, 0]])
    torch.testing.assert_close(box_iou(a, b), torch.tensor([1, 1 / 7, 0, 0]))
    metric = BoxIoU()
    metric.update(a[:1], b[:1])
    metric.update(a[1:3], b[1:3])
    assert float(metric.compute()) == pytest.approx((1 + 1 / 7) / 3)


def test_particles_on_the_object() -> None:
    mask = torch.zeros(2, 1, 10, 12, dtype=torch.bool)
    mask[:, :, 2:5, 6:9] = True
    pixels = torch.tensor([[6.0, 2.0], [8.4, 4.4], [8.6, 4.0], [-3.0, 2.0], [2.0, 6.0]]).expand(
        2, 5, 2
    )
    metric = ParticlesOnObject()
    metric.update(mask, pixels)
    assert float(metric.compute()) == pytest.approx(0.4)
