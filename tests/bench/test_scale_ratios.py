"""The bench of scale ratios counts what its columns are named for."""

import dataclasses
from collections.abc import Callable
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from posefilter.data.frames import Sample


@pytest.fixture
def bench(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("bench/scale_ratios.py")


SAMPLE = Sample(
    np.zeros((4, 4, 3), np.uint8),
    np.ones((4, 4), np.float32),
    np.ones((4, 4), dtype=bool),
    np.eye(3, dtype=np.float32),
    np.eye(4, dtype=np.float32),
    0,
    0,
    1.0,
)
MODEL = SimpleNamespace(
    points=torch.eye(3), center=torch.zeros(3), symmetries=torch.eye(4)[None], diameter=1.0
)


class Believing:
    """Puts the object as far away as the depth says, and measures its size if it is told to."""

    def __init__(self, measures: bool) -> None:
        self.measures = measures

    def predict(self, rgb: np.ndarray, depth: np.ndarray, intrinsics: np.ndarray) -> object:
        factor, pose = float(depth[0, 0]), np.eye(4)
        pose[2, 3] = factor - 1
        return SimpleNamespace(
            pose=pose,
            object_model=MODEL,
            presence=0.95,
            probability=0.9,
            costs=None,
            pose_tolerance=None,
            scale_ratio=factor if self.measures else np.nan,
            wrong_size=self.measures and factor != 1,
        )


@pytest.mark.parametrize("measures", [True, False])
def test_probable_and_wrong_answers_are_noticed_by_their_size(
    bench: ModuleType, measures: bool
) -> None:
    answers = [bench.ask(Believing(measures), SAMPLE)] * 3
    cells = bench.tabulate("box", answers).strip("| ").split(" | ")
    if measures:
        assert cells == ["box", "3", "1.00", "0", "1.25", "3", "3", "0.80", "3", "3"]
    else:
        assert cells[:2] == ["box", "3"]
        assert [cells[k] for k in (3, 5, 6, 8, 9)] == ["0", "3", "0", "3", "0"]


def test_images_whose_pose_is_wrong_anyway_do_not_count(bench: ModuleType) -> None:
    far = np.eye(4, dtype=np.float32)
    far[0, 3] = 0.5
    assert bench.ask(Believing(True), dataclasses.replace(SAMPLE, camera_from_object=far)) is None
