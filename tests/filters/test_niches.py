"""What niches make of few, equal, and weightless particles."""

import math

import pytest
import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.filters.loop import make_particles
from posefilter.filters.niches import Niches, draw_within, find_peaks
from posefilter.geometry.spaces import PixelSpace

PIXELS = PixelSpace()


def draw(state: Tensor, log_weights: Tensor, count: int, niches: int = 20) -> Tensor:
    particles = make_particles(state, 0)._replace(log_weights=log_weights.log_softmax(1))
    resampled = Niches(niches)(particles, count, PIXELS, Generator().manual_seed(0))
    assert resampled.ancestors.shape == (len(state), count)
    assert float(resampled.log_weights.logsumexp(1).abs().max()) < 1e-5
    return resampled.ancestors


def test_one_particle_has_all_children() -> None:
    assert (draw(torch.zeros(2, 1, 2), torch.zeros(2, 1), 7) == 0).all()


def test_equal_particles_are_drawn_as_often_as_each_other() -> None:
    """All are at one place: no distance tells them apart."""
    drawn = draw(torch.zeros(1, 12, 2), torch.zeros(1, 12), 12)
    assert drawn[0].sort().values.tolist() == list(range(12))


def test_a_particle_without_weight_is_no_peak_and_has_no_children() -> None:
    state = torch.arange(6.0)[None, :, None].repeat(1, 1, 2)
    log_w = torch.tensor([[0.0, 0.0, -math.inf, 0.0, -math.inf, -30.0]])
    assert set(draw(state, log_w, 12)[0].tolist()) == {0, 1, 3}


@pytest.mark.parametrize("count", [40, 26, 23, 7])
def test_niches_have_as_many_children_up_to_one(count: int) -> None:
    state = torch.randn(1, 40, 2, generator=Generator().manual_seed(1))
    niche = torch.arange(40) % 5
    log_w = torch.randn(40, generator=Generator().manual_seed(2)).log_softmax(0)
    ancestors, log_weights = draw_within(log_w, niche, 5, count, Generator().manual_seed(3))
    each = niche[ancestors].bincount(minlength=5)
    assert int(each.sum()) == count
    assert int(each.max() - each.min()) <= 1
    for k in range(5):
        mass = log_weights[niche[ancestors] == k].exp().sum()
        torch.testing.assert_close(mass, log_w[niche == k].double().exp().sum())
    assert len(find_peaks(state[0], log_w, PIXELS, 20)) == 20


def test_the_heaviest_particle_is_the_first_peak() -> None:
    state = torch.randn(50, 2, generator=Generator().manual_seed(2))
    log_w = torch.randn(50, generator=Generator().manual_seed(3))
    assert int(find_peaks(state, log_w, PIXELS, 5)[0]) == int(log_w.argmax())


def test_weights_that_are_no_numbers_are_left_to_the_filter_to_refuse() -> None:
    particles = make_particles(torch.zeros(1, 4, 2), 0)
    particles = particles._replace(log_weights=torch.full((1, 4), math.nan))
    new = Niches()(particles, 4, PIXELS, Generator().manual_seed(0))
    assert new.log_weights.isnan().all()


def test_a_filter_has_a_niche_at_least() -> None:
    with pytest.raises(UserError, match=r"filter\.resample\.niches=0"):
        Niches(0)
