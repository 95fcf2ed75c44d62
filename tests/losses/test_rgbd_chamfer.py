"""Chamfer distance over RGB-D values against naive loops."""

import pytest
import torch

from posefilter.losses.rgbd_chamfer import RgbdChamfer


@pytest.fixture
def colored(batch):
    g = torch.Generator().manual_seed(0)
    rgb = torch.rand(1, 3, 10, 20, generator=g, dtype=torch.float64)
    return batch._replace(rgb=rgb, depth=batch.depth + rgb[:, :1])


def values_at(batch, pixel: torch.Tensor) -> torch.Tensor:
    """Return the four numbers at a place between whole pixels, by hand; nothing off the frame."""
    image = torch.cat([batch.rgb, batch.depth], 1)[0]
    total = torch.zeros(4, dtype=torch.float64)
    u, v = pixel.tolist()
    for j in (int(v // 1), int(v // 1) + 1):
        for i in (int(u // 1), int(u // 1) + 1):
            if 0 <= i < 20 and 0 <= j < 10:
                total += image[:, j, i] * (1 - abs(u - i)) * (1 - abs(v - j))
    return total


@pytest.mark.parametrize("chunk", [1 << 20, 1])
def test_it_equals_the_naive_double_loop(colored, model, make_trace, chunk: int) -> None:
    state = torch.tensor([[[12.3, 7.6], [6.2, 3.1], [-0.5, 4.0]]], dtype=torch.float64)
    shift = torch.tensor([[[-1.0, 0.5], [0.3, 0.0], [0.0, 0.0]]], dtype=torch.float64)
    loss = RgbdChamfer(size=3, chunk=chunk)
    got = loss(make_trace(state, displacement=shift), colored, model).item()
    image = torch.cat([colored.rgb, colored.depth], 1)[0]
    target = image[:, colored.mask[0, 0]].T
    want = 0.0
    for place in (state + shift)[0]:
        patch = torch.stack(
            [
                values_at(colored, place + torch.tensor([i, j]))
                for j in (-1, 0, 1)
                for i in (-1, 0, 1)
            ]
        )
        squared = torch.cdist(patch, target) ** 2
        want += squared.min(1).values.mean().item() + squared.min(0).values.mean().item()
    assert got == pytest.approx(want / 3)


def test_it_teaches_the_displacement_by_what_is_seen_there(colored, model, make_trace) -> None:
    """Descent changes the values under the patch; no distance to the mask is in the loss."""
    shift = torch.tensor([[[0.2, 0.1]]], dtype=torch.float64, requires_grad=True)
    state = torch.tensor([[[13.0, 5.0]]], dtype=torch.float64)
    loss = RgbdChamfer(size=3)
    before = loss(make_trace(state, displacement=shift), colored, model)
    before.sum().backward()
    assert shift.grad.abs().min() > 0
    after = loss(make_trace(state, displacement=shift - 0.01 * shift.grad), colored, model)
    assert after.item() < before.item()
    # the same pixel values wherever the patch is: nothing to learn
    plain = colored._replace(rgb=torch.ones_like(colored.rgb), depth=torch.ones_like(colored.depth))
    shift.grad = None
    loss(make_trace(state, displacement=shift), plain, model).sum().backward()
    assert shift.grad.abs().max() < 1e-12


def test_an_image_without_the_object_costs_nothing(colored, model, make_trace) -> None:
    unseen = colored._replace(mask=torch.zeros_like(colored.mask))
    state = torch.tensor([[[6.0, 3.0]]], dtype=torch.float64)
    assert RgbdChamfer(size=3)(make_trace(state), unseen, model).tolist() == [0.0]
