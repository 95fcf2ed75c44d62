"""Glimpses against slices of the array, and against each other."""

import pytest
import torch

from posefilter.nets.glimpse import BilinearGlimpse, IntegerCut, sample


def image_and_pixels(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    image = torch.rand(2, 4, 20, 30, generator=g)
    u = torch.randint(-3, 34, (2, 50), generator=g)
    v = torch.randint(-3, 24, (2, 50), generator=g)
    return image, torch.stack([u, v], -1).float()


@pytest.mark.parametrize("size", [1, 3, 6, 9])
def test_integer_cut_is_a_slice_of_the_zero_padded_array(size: int) -> None:
    image, pixels = image_and_pixels()
    cut = IntegerCut(size)(image, pixels + 0.3)  # rounds back to the whole pixel
    pad = 20
    padded = torch.nn.functional.pad(image, (pad,) * 4)
    before = (size - 1) // 2
    for b in range(2):
        for n in range(50):
            u, v = (int(x) + pad - before for x in pixels[b, n])
            assert torch.equal(cut[b, n], padded[b, :, v : v + size, u : u + size])


@pytest.mark.parametrize("size", [1, 3, 6, 9])
def test_smooth_glimpse_equals_integer_cut_at_whole_pixels_and_only_there(size: int) -> None:
    image, pixels = image_and_pixels(1)
    cut, smooth = IntegerCut(size), BilinearGlimpse(size)
    torch.testing.assert_close(smooth(image, pixels), cut(image, pixels), atol=2e-5, rtol=0)
    between = pixels + 0.4
    assert (smooth(image, between) - cut(image, between)).abs().max() > 0.05


def test_only_the_smooth_glimpse_has_a_gradient_of_its_position() -> None:
    ramp = torch.arange(30.0).expand(1, 1, 20, 30) * 2
    pixels = torch.tensor([[[10.3, 8.6]]], requires_grad=True)
    BilinearGlimpse(3)(ramp, pixels).sum().backward()
    # 9 samples x slope 2
    torch.testing.assert_close(pixels.grad, torch.tensor([[[18.0, 0.0]]]), atol=1e-3, rtol=0)
    assert not IntegerCut(3)(ramp, pixels).requires_grad


def test_sampling_a_coarse_map_finds_cell_centers() -> None:
    cells = torch.arange(12.0).view(1, 1, 3, 4)
    center = torch.tensor([[[2 * 4 + 1.5, 1 * 4 + 1.5]]])
    assert sample(cells, center, stride=4).item() == pytest.approx(6.0, abs=1e-5)
    off = torch.tensor([[[500.0, 500.0]]])
    assert sample(cells, off, stride=4).item() == 0.0
    assert sample(cells, off, stride=4, padding="border").item() == pytest.approx(11.0)


def test_particles_far_off_the_frame_see_nothing() -> None:
    image, _ = image_and_pixels()
    far = torch.full((2, 3, 2), 1e30)
    assert IntegerCut(3)(image, far).abs().sum() == 0
