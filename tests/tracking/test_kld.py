"""KLD sampling: the size follows from the law of the divergence, and the loop from the size."""

import numpy as np
import pytest
import torch
from scipy.stats import chi2

from posefilter.geometry.spaces import PoseSpace
from posefilter.tracking.kld import bin_poses, count_needed, kld_size

SPACE = PoseSpace((0.01, -0.02, 0.03), 0.1)


@pytest.mark.parametrize("bins", [2, 5, 20, 100, 1000])
@pytest.mark.parametrize("quantile", [0.9, 0.99])
def test_the_size_is_the_quantile_of_chi_squared(bins: int, quantile: float) -> None:
    exact = chi2.ppf(quantile, bins - 1) / (2 * 0.05)
    assert kld_size(bins, 0.05, quantile) == pytest.approx(exact, rel=0.02, abs=1)


def test_so_many_draws_keep_the_divergence() -> None:
    """Of histograms of that many draws, the promised share is within the bound."""
    rng = np.random.default_rng(0)
    p = rng.dirichlet(np.full(30, 20.0))
    epsilon, quantile = 0.03, 0.95
    draws = rng.multinomial(kld_size(30, epsilon, quantile), p, size=4000) / kld_size(
        30, epsilon, quantile
    )
    terms = np.where(draws > 0, draws * np.log(np.maximum(draws, 1e-300) / p), 0)
    assert (terms.sum(1) <= epsilon).mean() == pytest.approx(quantile, abs=0.02)


def test_one_bin_needs_one_particle_and_more_bins_more() -> None:
    assert kld_size(1, 0.05, 0.99) == kld_size(2, 0.001, 0.01) == 1
    sizes = [kld_size(k, 0.05, 0.99) for k in range(1, 200)]
    assert sizes == sorted(sizes)
    assert kld_size(20, 0.05, 0.99) > kld_size(20, 0.1, 0.99) > kld_size(20, 0.1, 0.9)


def test_draws_stop_at_the_first_number_that_is_enough() -> None:
    cells = torch.randint(4, (500, 2), generator=torch.Generator().manual_seed(0))
    count = count_needed(cells, 0.1, 0.95, min_draws=10)

    def needed(n: int) -> int:
        return max(10, kld_size(len(cells[:n].unique(dim=0)), 0.1, 0.95))

    assert count >= needed(count)
    assert all(n < needed(n) for n in range(1, count))
    assert count_needed(cells[:30], 0.1, 0.95, min_draws=10) == 30  # where more would be needed
    assert count_needed(cells * 0, 0.1, 0.95, min_draws=10) == 10


def test_cells_count_shifts_and_turns_alike() -> None:
    about = torch.eye(4)
    tangent = torch.zeros(5, 6)
    tangent[1, 0] = 0.9  # cells of a side of 2 cm: 45 of them
    tangent[2, 2] = -0.009
    tangent[3, 4] = 0.4 / 0.1 * 0.1  # 4 cm at the radius
    tangent[4, 4] = 0.09
    cells = bin_poses(SPACE.move(about.expand(5, 4, 4), tangent), about, SPACE, 0.02)
    assert cells[0].tolist() == cells[2].tolist() == cells[4].tolist() == [0] * 6
    assert cells[1].tolist() == [45, 0, 0, 0, 0, 0]
    assert cells[3].tolist() == [0, 0, 0, 0, 2, 0]
