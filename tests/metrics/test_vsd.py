"""VSD by hand, against a naive loop, and against bop_toolkit where it is installed."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from posefilter.metrics.matching import match_greedily
from posefilter.metrics.vsd import DELTA, TAUS, to_distance, vsd

K = np.array([[60.0, 0, 9.5], [0, 62.0, 7.5], [0, 0, 1]])
H, W = 16, 20
FAR = np.full((H, W), 2.0)


def plate(rows: slice, columns: slice, z: float = 1.0) -> np.ndarray:
    """Return the depth of a plate that faces the camera."""
    out = np.zeros((H, W))
    out[rows, columns] = z
    return out


def test_distances_are_those_of_the_points() -> None:
    depth = np.random.default_rng(0).uniform(0.5, 2, (H, W))
    depth[3, 4] = 0
    found = to_distance(depth, K)
    for v, u in ((0, 0), (15, 19), (7, 3)):
        point = depth[v, u] * np.linalg.solve(K, [u, v, 1])
        assert found[v, u] == pytest.approx(np.linalg.norm(point))
    assert found[3, 4] == 0


def test_what_is_known_by_hand() -> None:
    whole, half = slice(0, 16), slice(4, 12)
    true = plate(whole, slice(4, 12))
    measured = np.where(true > 0, true, FAR)
    assert vsd(true, true, measured, K, 0.2).tolist() == [0.0] * 10
    # beside it: no pixel is shared, and before the wall both are visible
    assert vsd(plate(whole, slice(12, 20)), true, measured, K, 0.2).tolist() == [1.0] * 10
    # shifted by half of its width: a third of the union is shared, all of it right
    shifted = vsd(plate(whole, slice(8, 16)), true, measured, K, 0.2)
    assert shifted.tolist() == pytest.approx([2 / 3] * 10)
    # 1 cm nearer, in the middle: 0.05 of the diameter, so wrong at the least misalignment only
    nearer = vsd(plate(whole, slice(4, 12), 0.9899), true, measured, K, 0.2)
    assert nearer.tolist() == [1.0] + [0.0] * 9
    assert vsd(plate(half, slice(4, 12)), true, measured, K, 0.2).tolist() == [0.5] * 10
    assert vsd(np.zeros((H, W)), np.zeros((H, W)), measured, K, 0.2).tolist() == [1.0] * 10


def test_what_is_hidden_does_not_count_and_what_is_unknown_does() -> None:
    true = plate(slice(0, 16), slice(4, 12))
    guess = plate(slice(0, 16), slice(4, 10))  # wrong in the columns 10 and 11
    hidden = np.where(true > 0, true, FAR)
    hidden[:, 10:12] = 0.5  # something before them
    assert vsd(guess, true, hidden, K, 0.2).tolist() == [0.0] * 10
    unknown = hidden.copy()
    unknown[:, 10:12] = 0
    assert vsd(guess, true, unknown, K, 0.2).tolist() == [0.25] * 10
    # behind the measured surface by no more than the tolerance is still visible
    behind = plate(slice(0, 16), slice(4, 12), 1.0 + 0.9 * DELTA)
    assert vsd(behind, true, np.where(true > 0, true, FAR), K, 10.0).tolist() == [0.0] * 10


def draw(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return depths of an estimate, a truth and an image, with holes."""
    rng = np.random.default_rng(seed)
    true = np.where(rng.random((H, W)) < 0.6, 1 + 0.05 * rng.normal(size=(H, W)), 0)
    guess = np.where(rng.random((H, W)) < 0.6, 1 + 0.05 * rng.normal(size=(H, W)), 0)
    measured = np.where(rng.random((H, W)) < 0.9, 1 + 0.05 * rng.normal(size=(H, W)), 0)
    return guess, true, measured


def test_against_a_naive_loop() -> None:
    for seed in range(5):
        guess, true, measured = draw(seed)
        wrong, union = np.zeros(len(TAUS)), 0
        for v in range(H):
            for u in range(W):
                ray = math.hypot((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], 1)
                g, t, m = (float(d[v, u]) * ray for d in (guess, true, measured))
                sees_t = t > 0 and (t - m <= DELTA or m == 0)
                sees_g = g > 0 and (g - m <= DELTA or m == 0 or sees_t)
                union += sees_t or sees_g
                for k, tau in enumerate(TAUS):
                    if sees_t != sees_g or (sees_t and abs(g - t) / 0.3 >= tau):
                        wrong[k] += 1
        assert vsd(guess, true, measured, K, 0.3).tolist() == pytest.approx(wrong / union)


def test_against_bop_toolkit() -> None:
    pose_error = pytest.importorskip("bop_toolkit_lib.pose_error")
    matching = pytest.importorskip("bop_toolkit_lib.pose_matching")
    for seed in range(5):
        guess, true, measured = draw(seed)
        drawn = iter([{"depth": 1000 * guess}, {"depth": 1000 * true}])
        renderer = SimpleNamespace(render_object=lambda *_: next(drawn))  # noqa: B023
        eye, none = np.eye(3), np.zeros((3, 1))
        theirs = pose_error.vsd(
            eye, none, eye, none, 1000 * measured, K, 15, TAUS, True, 300.0, renderer, 1
        )
        assert vsd(guess, true, measured, K, 0.3).tolist() == pytest.approx(theirs, abs=1e-3)
    rng = np.random.default_rng(0)
    for _ in range(20):
        errors = rng.random((4, 3))
        estimates = [
            {
                "est_id": i,
                "score": -i,
                "errors": {t: [errors[i, t]] for t in range(3)},
                "gt_visib_fracts": [1.0] * 3,
            }
            for i in range(4)
        ]
        matched = matching.match_poses(estimates, [0.5])
        assert [(m["est_id"], m["gt_id"]) for m in matched] == match_greedily(errors, 0.5)
