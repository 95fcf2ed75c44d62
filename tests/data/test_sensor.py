"""The sensor model against what it promises, and against real depth."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from posefilter.synthetic.sensor import (
    simulate_color,
    simulate_depth,
    simulate_sensor,
)

H, W = 240, 320


def step_scene() -> np.ndarray:
    depth = np.full((H, W), 1.2, np.float32)
    depth[80:160, 120:200] = 0.8
    return depth


def flat(z: float) -> np.ndarray:
    return np.full((H, W), z, np.float32)


GREY = np.full((H, W, 3), 0.5, np.float32)


def test_the_ideal_sensor_changes_nothing() -> None:
    rgb = np.random.default_rng(0).uniform(0, 1.2, (H, W, 3)).astype(np.float32)
    photo, depth = simulate_sensor(rgb, step_scene(), "ideal", np.random.default_rng(0))
    np.testing.assert_array_equal(depth, step_scene())
    assert np.abs(photo / 255 - np.clip(rgb, 0, 1)).max() <= 0.5 / 255 + 1e-6


def test_the_same_generator_gives_the_same_images() -> None:
    a, b, c = (
        simulate_sensor(GREY, step_scene(), "kinect", np.random.default_rng(s)) for s in (1, 1, 2)
    )
    np.testing.assert_array_equal(a[0], b[0])
    np.testing.assert_array_equal(a[1], b[1])
    assert (a[0] != c[0]).any()
    assert (a[1] != c[1]).any()


def test_depth_errors_are_millimeters_and_grow_with_distance() -> None:
    near, far = [], []
    for seed in range(24):
        for z, errors in ((0.6, near), (1.2, far)):
            out = simulate_depth(flat(z), GREY, np.random.default_rng(seed))
            errors.append(np.median(np.abs(out - z)[out > 0]) * 1000)
    assert 0.3 < np.median(near) < 3
    assert 1 < np.median(far) < 6  # real depth lies 2 to 3.6 mm off
    assert np.median(far) > 2 * np.median(near)


def test_disparity_comes_in_steps() -> None:
    slope = np.broadcast_to(np.linspace(0.8, 1.4, W, dtype=np.float32), (H, W)).copy()
    counts = [
        len(np.unique(simulate_depth(slope, GREY, np.random.default_rng(s)))) for s in range(12)
    ]
    assert np.median(counts) < 2000  # 76,800 pixels without steps
    assert min(counts) > 50


def test_depth_is_lost_at_edges_more_than_elsewhere() -> None:
    edge = (
        cv2.dilate(
            (np.abs(cv2.Laplacian(step_scene(), cv2.CV_32F)) > 0.1).astype(np.uint8),
            np.ones((5, 5)),
        )
        > 0
    )
    at_edge, elsewhere = [], []
    for seed in range(20):
        lost = simulate_depth(step_scene(), GREY, np.random.default_rng(seed)) == 0
        at_edge.append(lost[edge].mean())
        elsewhere.append(lost[~edge].mean())
    assert np.mean(at_edge) > 0.25
    assert np.mean(elsewhere) < 0.1
    assert np.mean(at_edge) > 4 * np.mean(elsewhere)


def test_edges_are_ragged_but_stay_within_pixels() -> None:
    spread = []
    for seed in range(12):
        out = simulate_depth(step_scene(), GREY, np.random.default_rng(seed))
        box = (out > 0) & (out < 1.0)
        rows, columns = np.nonzero(box)
        assert abs(rows.min() - 80) <= 6
        assert abs(rows.max() - 159) <= 6
        assert abs(columns.min() - 120) <= 6
        assert abs(columns.max() - 199) <= 6
        left = box[90:150, 110:140].argmax(1)
        spread.append(left.std())
    assert np.median(spread) > 0.2  # a clean edge would have none


def test_nothing_stays_nothing() -> None:
    depth = np.zeros((H, W), np.float32)
    assert not simulate_depth(depth, GREY, np.random.default_rng(0)).any()


def test_color_stays_in_range_and_varies_in_brightness() -> None:
    means = []
    for seed in range(20):
        photo = simulate_color(GREY * np.float32(1.3), np.random.default_rng(seed))
        assert photo.min() >= 0
        assert photo.max() <= 1
        means.append(photo.mean())
    assert 0.05 < np.std(means) < 0.3


@pytest.mark.slow
def test_real_depth_could_have_come_from_it(real_data: Path) -> None:
    shares, holes = [], []
    for path in sorted((real_data / "ycbv" / "data").glob("*/*-depth.png")):
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float32) / 1e4
        if depth.size:
            shares.append((depth == 0).mean())
            whole = cv2.inpaint(
                (depth * 100).astype(np.uint8), (depth == 0).astype(np.uint8), 3, cv2.INPAINT_NS
            ) / np.float32(100)
            model = [
                simulate_depth(
                    whole, np.full((*depth.shape, 3), 0.5, np.float32), np.random.default_rng(s)
                )
                for s in range(6)
            ]
            holes.append([(m == 0).mean() for m in model])
    assert len(shares) >= 10
    low, high = np.percentile(holes, [0, 100])
    assert low < np.median(shares) < high
