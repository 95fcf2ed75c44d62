"""Maps are looked up where their cells lie in the image; masks are listed and eroded exactly."""

import pytest
import torch

from posefilter.geometry.lookup import (
    centroid,
    erode,
    gather_pixels,
    gather_rows,
    mask_pixels,
    nearest_mask_pixel,
    nearest_pixel,
    patch_offsets,
    sample,
)


@pytest.mark.parametrize("stride", [1, 2, 4])
def test_a_cells_value_is_at_the_middle_of_its_pixels(stride: int) -> None:
    """A map of planes u and v, in pixels: what is sampled at a place is the place."""
    h, w = 5, 7
    middle = (stride - 1) / 2
    u = (torch.arange(w) * stride + middle).expand(h, w)
    v = (torch.arange(h) * stride + middle)[:, None].expand(h, w)
    image = torch.stack([u, v])[None]
    g = torch.Generator().manual_seed(0)
    size = torch.tensor([(w - 1) * stride, (h - 1) * stride])
    places = torch.rand(1, 20, 2, generator=g) * size + middle
    torch.testing.assert_close(sample(image, places, stride), places)
    # half a cell beyond the last middle a value has faded by half, or stays as it was
    edge = torch.tensor([[[middle - stride / 2, middle]]])
    ones = torch.ones(1, 1, h, w)
    assert sample(ones, edge, stride).item() == pytest.approx(0.5)
    assert sample(ones, edge, stride, "border").item() == pytest.approx(1)


def test_maps_of_a_single_row_or_column_are_sampled_too() -> None:
    line = torch.arange(5.0)
    along = torch.tensor([[[2.5, 0.0]]])
    assert sample(line.view(1, 1, 1, 5), along).item() == pytest.approx(2.5)
    assert sample(line.view(1, 1, 5, 1), along.flip(-1)).item() == pytest.approx(2.5)


def test_halves_are_rounded_upwards_and_infinities_do_not_overflow() -> None:
    pixels = torch.tensor([[0.5, -0.5], [1.49, -1.51], [1e30, -1e30]])
    assert nearest_pixel(pixels).tolist() == [[1, 0], [1, -2], [1000000, -1000000]]


def test_pixels_off_the_frame_are_zero_on_each_side() -> None:
    image = torch.arange(1.0, 7.0).view(1, 1, 2, 3)
    index = torch.tensor([[[0, 0], [2, 1], [-1, 0], [3, 0], [0, -1], [0, 2]]])
    assert gather_pixels(image, index)[0, :, 0].tolist() == [1, 6, 0, 0, 0, 0]


@pytest.mark.parametrize("learned", [False, True])
def test_rows_are_those_of_each_images_own_table(learned: bool) -> None:
    table = torch.arange(24.0).view(2, 4, 3).requires_grad_(learned)
    rows = gather_rows(table, torch.tensor([[3, 0], [1, 1]]))
    assert rows.tolist() == [[[9, 10, 11], [0, 1, 2]], [[15, 16, 17], [15, 16, 17]]]
    assert rows.requires_grad == learned


def test_offsets_of_a_patch_are_in_raster_order() -> None:
    assert patch_offsets(2).tolist() == [[0, 0], [1, 0], [0, 1], [1, 1]]
    assert patch_offsets(3)[:4].tolist() == [[-1, -1], [0, -1], [1, -1], [-1, 0]]


def test_a_selection_of_a_mask_is_even_and_has_both_ends() -> None:
    mask = torch.zeros(2, 1, 3, 20, dtype=torch.bool)
    mask[0, 0, 1, 4:15] = True
    places, real = mask_pixels(mask, max_pixels=6)
    assert places[0, :, 0].tolist() == [4, 6, 8, 10, 12, 14]
    assert real.tolist() == [[True] * 6, [False] * 6]
    assert mask_pixels(mask, max_pixels=11)[0].shape == (2, 11, 2)
    none, real = mask_pixels(mask[1:])
    assert none.shape == (1, 1, 2)  # of no pixels, one that is padding
    assert not real.any()


@pytest.mark.parametrize("margin", [1, 3])
def test_erosion_by_a_margin_of_pixels(margin: int) -> None:
    mask = torch.zeros(1, 1, 20, 16, dtype=torch.bool)
    mask[..., 2:14, 1:12] = True
    want = torch.zeros_like(mask)
    want[..., 2 + margin : 14 - margin, 1 + margin : 12 - margin] = True
    assert torch.equal(erode(mask, margin), want)
    assert erode(mask, 0) is mask


def test_the_pixel_that_a_place_rounds_to_is_its_own() -> None:
    """Even where a rim's pixel would be as near."""
    mask = torch.zeros(1, 1, 9, 9, dtype=torch.bool)
    mask[..., 1:8, 1:8] = True
    places = torch.tensor([[[4.4, 4.4], [4.6, 3.4], [0.2, 4.4], [8.9, 8.9]]])
    assert nearest_mask_pixel(mask, places)[0].tolist() == [[4, 4], [5, 3], [1, 4], [7, 7]]


def test_the_center_of_a_mask_is_the_mean_of_its_pixels() -> None:
    mask = torch.zeros(2, 1, 6, 9, dtype=torch.bool)
    mask[0, 0, 1, 2] = mask[0, 0, 1, 3] = mask[0, 0, 4, 7] = True
    assert centroid(mask).tolist() == [[4.0, 2.0], [4.0, 2.5]]
