"""What shows nothing is told from what shows little: noise, darkness, depth in a few places."""

import numpy as np
import pytest

from posefilter.confidence.blank import find_blank

H, W = 240, 320
RANDOM = np.random.default_rng(0)
RAMP = np.broadcast_to(np.linspace(0.5, 1.5, W, dtype=np.float32), (H, W))


def scene(brightness: float = 1.0) -> np.ndarray:
    """Return a picture of which a thirtieth is not the ground."""
    rgb = np.full((H, W, 3), 180.0)
    rgb[60:100, 80:144] = (150, 40, 30)
    return (brightness * rgb).round().astype(np.uint8)


@pytest.mark.parametrize(
    ("rgb", "told"),
    [
        (scene(), ""),
        (scene(0.1), ""),
        (scene(0.03), "black"),
        (scene() / 255.0, ""),
        (scene() / 255.0**2, "divided by 255 twice"),
        (np.zeros((H, W, 3), np.uint8), "black"),
        (RANDOM.normal(3, 3, (H, W, 3)).clip(0, 255).astype(np.uint8), "black"),
        (np.full((H, W, 3), (200, 30, 40), np.uint8), "of one color"),
        (RANDOM.normal(200, 3, (H, W, 3)).clip(0, 255).astype(np.uint8), "of one color"),
        (np.zeros((5, 5, 3), np.uint8), "black"),
    ],
)
def test_colors(rgb: np.ndarray, told: str) -> None:
    said = find_blank(rgb, RAMP[: len(rgb), : rgb.shape[1]])
    assert told in said
    assert bool(said) == bool(told)


def sparse(count: int) -> np.ndarray:
    depth = np.zeros((H, W), np.float32)
    depth.reshape(-1)[RANDOM.permutation(depth.size)[:count]] = RANDOM.uniform(0.5, 1.5, count)
    return depth


@pytest.mark.parametrize(
    ("depth", "told"),
    [
        (RAMP, ""),
        (np.where(RAMP > 1.4, RAMP, np.nan), ""),
        (sparse(200), ""),
        (sparse(1), "1 of 76800 pixels have depth"),
        (np.zeros((H, W)), "0 of 76800 pixels have depth"),
        (np.full((H, W), 0.7), "0.7 m everywhere"),
        (np.where(RAMP > 1, 0.7, 0.0), "0.7 m everywhere"),
    ],
)
def test_depths(depth: np.ndarray, told: str) -> None:
    said = find_blank(scene(), depth)
    assert told in said
    assert bool(said) == bool(told)
