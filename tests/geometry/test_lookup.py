"""Look-ups in masks against naive loops."""

import pytest
import torch

from posefilter.geometry.lookup import (
    argmin,
    centroid,
    erode,
    mask_pixels,
    nearest_mask_pixel,
    overlaps_mask,
)


def blobs(seed: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    coarse = torch.rand(3, 1, 6, 8, generator=g) < 0.3
    return coarse.repeat_interleave(4, 2).repeat_interleave(4, 3)


@pytest.mark.parametrize("seed", range(5))
def test_nearest_true_is_the_nearest_of_all_mask_pixels(seed: int) -> None:
    mask = blobs(seed)
    g = torch.Generator().manual_seed(seed)
    # in and out of the frame
    places = torch.rand(3, 200, 2, generator=g) * torch.tensor([60.0, 50.0]) - 14
    found = nearest_mask_pixel(mask, places, chunk=500)
    for b in range(3):
        every = mask[b, 0].nonzero().flip(-1).float()
        distance = (places[b][:, None] - every).norm(dim=-1).min(1).values
        torch.testing.assert_close((found[b] - places[b]).norm(dim=-1), distance)
        assert all(mask[b, 0, int(v), int(u)] for u, v in found[b])


def test_of_equal_values_the_first_is_the_least() -> None:
    values = torch.tensor(
        [[[2.0, 1.0, 1.0], [0.0, 0.0, 0.0]], [[3.0, 2.0, -torch.inf], [torch.inf, 5.0, 5.0]]]
    )
    assert argmin(values).tolist() == [[1, 0], [2, 1]]
    assert torch.equal(argmin(values), values.argmin(-1))


def test_an_empty_mask_gives_no_displacement() -> None:
    mask = blobs(0)
    mask[1] = False
    places = torch.rand(3, 5, 2) * 20
    assert torch.equal(nearest_mask_pixel(mask, places)[1], places[1])
    assert torch.equal(centroid(mask)[1], torch.tensor([15.5, 11.5]))


@pytest.mark.parametrize("size", [1, 3, 6, 9])
def test_touches_is_what_a_loop_over_the_glimpse_finds(size: int) -> None:
    mask = blobs(2)
    g = torch.Generator().manual_seed(1)
    places = torch.stack(
        [torch.randint(-6, 38, (3, 80), generator=g), torch.randint(-6, 30, (3, 80), generator=g)],
        -1,
    )
    met = overlaps_mask(mask, places.float(), size)
    for b in range(3):
        for n in range(80):
            u, v = (int(x) - (size - 1) // 2 for x in places[b, n])
            seen = mask[b, 0, max(v, 0) : max(v + size, 0), max(u, 0) : max(u + size, 0)]
            assert bool(met[b, n]) == bool(seen.any())


def test_shrink_leaves_the_pixels_whose_surroundings_are_all_mask() -> None:
    mask = torch.zeros(2, 1, 12, 12, dtype=torch.bool)
    mask[0, 0, 0:7, 3:10] = True
    mask[1, 0, 5, 5] = True
    small = erode(mask, 2)
    wanted = torch.zeros(12, 12, dtype=torch.bool)
    wanted[2:5, 5:8] = True  # the frame's edge counts as background
    assert torch.equal(small[0, 0], wanted)
    assert torch.equal(small[1], mask[1])


def test_lists_and_centers() -> None:
    mask = torch.zeros(2, 1, 9, 9, dtype=torch.bool)
    mask[0, 0, 2:4, 5:8] = True
    mask[1, 0, 8, 0] = True
    places, real = mask_pixels(mask)
    assert real.sum(1).tolist() == [6, 1]
    assert places[1, 0].tolist() == [0.0, 8.0]
    assert centroid(mask).tolist() == [[6.0, 2.5], [0.0, 8.0]]
    assert mask_pixels(mask, max_pixels=3)[1].sum(1).tolist() == [3, 1]
