"""bench/belief_baseline.py: error models are fitted and judged as a table of them should be."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import multivariate_t

sys.path.insert(0, str(Path(__file__).parents[1] / "bench"))
from belief_baseline import (
    SHIPPED,
    Errors,
    bootstrap,
    compare,
    fit_covariance,
    fit_scale,
    judge,
    tabulate,
)

WIDE = np.diag([1.0, 2.0, 4.0, 1.0, 0.5, 3.0]) ** 2
EVEN = np.broadcast_to(np.eye(6), (4000, 6, 6))


def draw(shape: np.ndarray, degrees: int, count: int, seed: int = 0) -> np.ndarray:
    return np.asarray(multivariate_t(np.zeros(6), shape, degrees, seed=seed).rvs(count))


def test_the_density_and_the_levels_are_those_of_students_t() -> None:
    twist = draw(WIDE, 5, 4000)
    found = judge(twist, WIDE, 5)
    expected = multivariate_t(np.zeros(6), WIDE, 5).logpdf(twist)
    np.testing.assert_allclose(found.log_density, expected)
    np.testing.assert_allclose(judge(twist, WIDE * EVEN[:, :1, :1], 5).log_density, expected)
    assert [(found.level < p).mean() for p in (0.5, 0.95)] == pytest.approx([0.5, 0.95], abs=0.02)


def test_what_is_fitted_is_what_errors_were_drawn_from() -> None:
    twist = draw(WIDE, 3, 4000)
    own = fit_covariance(twist, EVEN, 3)
    np.testing.assert_allclose(np.diag(own) / np.diag(WIDE), 1, atol=0.12)
    sizes = np.exp(np.random.default_rng(1).normal(size=4000))
    own = fit_covariance(sizes[:, None] * twist, sizes[:, None, None] ** 2 * EVEN, 3)
    np.testing.assert_allclose(np.diag(own) / np.diag(WIDE), 1, atol=0.12)
    assert float(fit_scale(2 * twist, WIDE * EVEN[:, :1, :1], 3)) == pytest.approx(4, rel=0.06)


@pytest.mark.parametrize("by_image", [False, True])
def test_the_better_model_gains(by_image: bool) -> None:
    """One covariance where the image's width is noise, and the image's where errors go by it."""
    rng = np.random.default_rng(2)
    factor = np.exp(0.7 * rng.normal(size=400))
    twist = draw(np.eye(6), 5, 400) * (factor[:, None] if by_image else 1.0)
    right = np.arange(400) % 10 > 0
    twist[~right] += 1e3  # which no fit may have seen
    scene = np.repeat(np.arange(200), 2).astype(str)
    shipped = factor[:, None, None] ** 2 * EVEN[:400]
    found = Errors(twist, EVEN[:400], shipped, right, rng.uniform(size=400), scene)
    said = compare(found, 5)
    gain = (said["one covariance"].log_density - said[SHIPPED].log_density)[right]
    _, low, high = bootstrap(gain, scene[right])
    assert high < 0 if by_image else low > 0
    best = said[SHIPPED if by_image else "one covariance"].level[right]
    assert (best < 0.9).mean() == pytest.approx(0.9, abs=0.04)
    rows = tabulate("carton", found, said)
    assert rows[0][:3] == ["carton", "360 of 400", SHIPPED]
    assert rows[0][4] == "–"
    assert rows[1][4].startswith("-" if by_image else "+")


def test_scenes_are_resampled_whole() -> None:
    """Two frames of one scene that agree are no more than one."""
    values = np.random.default_rng(0).normal(size=100)
    once = bootstrap(values, np.arange(100).astype(str))
    twice = bootstrap(np.repeat(values, 2), np.repeat(np.arange(100), 2).astype(str))
    np.testing.assert_allclose(once, twice)
    assert once[2] - once[1] == pytest.approx(2 * 1.96 * values.std() / 10, rel=0.1)
