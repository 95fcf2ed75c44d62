"""The window about a tracked object: whole cells, and no more of them than allowed."""

import numpy as np
import pytest
import torch

from posefilter.tracking.window import place_window
from posefilter.types import ObjectModel

K = np.array([[1000.0, 0, 640], [0, 1000, 480], [0, 0, 1]])
EYE = torch.eye(3)
MODEL = ObjectModel("ball", EYE, torch.zeros(3), 0.1, 0.2, torch.eye(4)[None], EYE)


def at(x: float, z: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3], pose[2, 3] = x, z
    return pose


@pytest.mark.parametrize("side", [64, 100, 320, 330])
@pytest.mark.parametrize("x", [0.0, 0.0037, -0.0123])
def test_a_window_within_the_photograph_is_of_whole_cells_and_not_larger(
    side: int, x: float
) -> None:
    window = place_window(at(x, 0.6), MODEL, K, (960, 1280), 1.0, side, 1.25)
    assert window is not None
    assert window.seen_width == window.seen_height == side // 32 * 32
    assert window.left % 2 == window.top % 2 == 0
    center = window.left + window.width / 2
    assert abs(center - (640 + 1000 * x / 0.6)) <= 2


def test_a_far_object_has_a_smaller_window_at_the_scale_of_training() -> None:
    window = place_window(at(0.0, 2.0), MODEL, K, (960, 1280), 0.5, 320, 1.25)
    assert window is not None
    assert window.seen_width == 64  # 125 px at half the scale
    assert window.width == 128


def test_a_window_is_cut_at_the_photographs_edge() -> None:
    window = place_window(at(-0.35, 0.6), MODEL, K, (960, 1280), 1.0, 320, 1.25)
    assert window is not None
    assert window.left == 0
    assert window.seen_width < window.seen_height == 320
    assert place_window(at(-5.0, 0.6), MODEL, K, (960, 1280), 1.0, 320, 1.25) is None
    assert place_window(at(0.0, 0.04), MODEL, K, (960, 1280), 1.0, 320, 1.25) is None
