"""A dataset may declare other symmetries of an object than its checkpoint knows."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from posefilter.cli.evaluate import judge_by
from posefilter.types import ObjectModel

ONE = torch.eye(4)[None]
TWO = torch.stack([torch.eye(4), torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))])


def make_model(symmetries: torch.Tensor) -> ObjectModel:
    points = torch.randn(9, 3)
    return ObjectModel("can", points, torch.zeros(3), 0.1, 0.2, symmetries, points)


@pytest.mark.parametrize(("known", "declared", "kept"), [(1, 1, True), (2, 2, True), (1, 2, False)])
def test_a_calibration_that_knows_other_features_is_left_out(
    known: int, declared: int, kept: bool
) -> None:
    group = {1: ONE, 2: TWO}
    method: Any = SimpleNamespace(
        object_model=make_model(group[known]), calibration="its", calibration_note=""
    )
    method.set_object = lambda model: setattr(method, "object_model", model)
    judge_by(method, make_model(group[declared]))
    assert len(method.object_model.symmetries) == declared
    assert (method.calibration == "its") is kept
    if not kept:
        assert method.calibration_note == (
            "the dataset's meshes declare 1 symmetries of can, and the checkpoint was calibrated "
            "with 0"
        )
