"""Errors are told apart by visibility, each range by its own instances alone."""

import torch
from tests.models.toy import square

from posefilter.geometry.pose import make_pose
from posefilter.metrics.collect import ErrorsByVisibility, PoseErrors
from posefilter.metrics.scores import InstanceErrors


def measure(poses: torch.Tensor, truth: torch.Tensor) -> InstanceErrors:
    errors = PoseErrors([square()])
    errors.update(poses, truth)
    return errors.last()


def test_each_range_has_its_own_instances() -> None:
    truth = torch.eye(4).expand(5, 4, 4)
    shifts = torch.tensor([0.0, 0.15, 0.0, 0.2, 0.3])
    poses = make_pose(
        torch.eye(3).expand(5, 3, 3), torch.stack([shifts, shifts * 0, shifts * 0], -1)
    )
    metric = ErrorsByVisibility([square()])
    metric.update(measure(poses[:3], truth[:3]), torch.tensor([1.0, 0.4, 0.3]))
    metric.update(measure(poses[3:], truth[3:]), torch.tensor([0.7, float("nan")]))
    got = metric.compute()
    assert set(got) == {"0.3-0.5", "0.5-0.8", "0.8-1", "0.5-1", "0.6-1"}
    assert got["0.3-0.5"]["instances"] == 2
    assert abs(got["0.3-0.5"]["add"]["auc"] - 50.0) < 1e-3  # errors of 0 and 15 cm
    assert got["0.5-0.8"]["add"]["auc"] == 0
    assert got["0.8-1"]["add"]["auc"] == 100
    assert abs(got["0.5-1"]["add"]["recall_01d"] - 50) < 1e-6
    metric.reset()
    assert metric.compute() == {}


def test_a_share_between_two_ranges_is_of_the_higher_one() -> None:
    metric = ErrorsByVisibility([square()], ranges=((0.25, 0.5), (0.5, 0.75), (0.75, 1.0)))
    truth = torch.eye(4).expand(4, 4, 4)
    metric.update(measure(truth, truth), torch.tensor([0.25, 0.5, 0.75, 1.0]))
    counted = {name: found["instances"] for name, found in metric.compute().items()}
    assert counted == {"0.25-0.5": 1, "0.5-0.75": 1, "0.75-1": 2}
