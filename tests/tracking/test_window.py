"""The window about a tracked object: whole cells, and no more of them than allowed."""

import numpy as np
import pytest
import torch

from posefilter.images import Images
from posefilter.tracking.window import Frame, place_window
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


def test_a_window_of_a_small_photograph_is_seen_although_cells_stretch_it() -> None:
    """Where the scale is above 1 and not whole, an edge cuts windows to whole pixels of both."""
    draw = np.random.default_rng(0)
    height, width = 144, 176
    own = np.array([[170.0, 0, 87.5], [0, 170, 71.5], [0, 0, 1]])
    rgb = draw.integers(0, 256, (1, height, width, 3), dtype=np.uint8)
    frame = Frame(Images(rgb, np.ones((1, height, width), np.float32), own[None]))
    stretched = 0
    for place in draw.uniform(-0.55, 0.55, (200, 2)):
        pose = at(2.2 * place[0], 2.2)
        pose[1, 3] = 2.2 * 0.7 * place[1]
        window = place_window(pose, MODEL, own, (height, width), 320 / width, 160, 1.25)
        if window is None:
            continue
        batch = frame.see_window(window)
        assert batch.rgb.shape[2:] == (window.seen_height, window.seen_width)
        scale = batch.intrinsics[0].diagonal()[:2].double().numpy() / 170
        np.testing.assert_allclose(
            scale, (window.seen_width / window.width, window.seen_height / window.height), rtol=1e-6
        )
        stretched += abs(scale[0] / scale[1] - 1) > 0.02
    assert stretched > 5
