"""The faster linear layer is a linear layer."""

import pytest
import torch
from torch import nn

from posefilter.nets.linear import Linear, has_onednn, takes_onednn

pytestmark = pytest.mark.skipif(not has_onednn(), reason="this PyTorch has no oneDNN")


def both(dtype: torch.dtype = torch.float32, bias: bool = True) -> tuple[nn.Linear, Linear]:
    torch.manual_seed(0)
    plain, fast = nn.Linear(37, 19, bias=bias, dtype=dtype), Linear(37, 19, bias=bias, dtype=dtype)
    fast.load_state_dict(plain.state_dict())
    return plain, fast


@pytest.mark.parametrize("bias", [True, False])
def test_values_and_gradients_are_the_plain_layers(bias: bool) -> None:
    layers = both(bias=bias)
    g = torch.Generator().manual_seed(1)
    x, weight = torch.randn(3, 50, 37, generator=g), torch.randn(3, 50, 19, generator=g)
    assert takes_onednn(x, layers[1].weight)
    found = []
    for layer in layers:
        seen = x.clone().requires_grad_()
        out = layer(seen)
        out.mul(weight).sum().backward()
        found.append([out.detach(), seen.grad, *(p.grad for p in layer.parameters())])
    assert len(found[0]) == 4 if bias else 3
    for plain, fast in zip(*found, strict=True):
        assert (plain - fast).norm() < 1e-6 * plain.norm()


def test_a_gradient_that_is_one_number_expanded_is_read_right() -> None:
    layers = both()
    for layer in layers:
        layer(torch.ones(6, 37)).sum().backward()
    torch.testing.assert_close(layers[0].weight.grad, layers[1].weight.grad)


def test_what_needs_no_gradient_gets_none() -> None:
    _, fast = both()
    fast.weight.requires_grad_(False)
    x = torch.ones(2, 37)
    fast(x).sum().backward()
    assert x.grad is None
    assert fast.weight.grad is None
    assert fast.bias.grad.tolist() == [2.0] * 19


def test_other_types_and_autocast_are_left_to_pytorch() -> None:
    plain, fast = both(torch.float64)
    x = torch.rand(4, 37, dtype=torch.float64)
    assert not takes_onednn(x, fast.weight)
    assert torch.equal(plain(x), fast(x))
    plain, fast = both()
    with torch.autocast("cpu", torch.bfloat16):
        assert fast(x.float()).dtype == torch.bfloat16
    assert fast(torch.zeros(0, 37)).shape == (0, 19)
