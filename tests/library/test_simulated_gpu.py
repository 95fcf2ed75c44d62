"""The simulated GPU refuses what CUDA refuses, and else computes the same numbers."""

import copy
import io
from collections.abc import Callable

import numpy as np
import pytest
import torch
from tests.simulated_gpu import GPU, simulate_gpu
from torch import Tensor, nn


@pytest.fixture
def pair() -> tuple[Tensor, Tensor]:
    """Return the same numbers on the GPU and on the CPU."""
    with simulate_gpu() as gpu:
        here = torch.arange(6.0)
        return here.to(gpu), here


@pytest.mark.parametrize(
    "mix",
    [
        lambda a, b: a + b,
        lambda a, b: b.gather(0, a.long()),
        lambda a, b: b[a.long()],
        lambda a, b: torch.stack([a, b]),
        lambda a, b: torch.where(a > 1, b, b),
        lambda a, b: nn.functional.linear(a, b[None]),
        lambda a, b: a.index_select(0, b.long()),
        lambda a, b: torch.rand(3, device=GPU, generator=torch.Generator("cpu")),
        lambda a, b: torch.randn(3, generator=torch.Generator(device=GPU)),
        lambda a, b: torch.multinomial(b, 2, generator=torch.Generator(device=GPU)),
    ],
)
def test_devices_are_not_mixed(
    pair: tuple[Tensor, Tensor], mix: Callable[[Tensor, Tensor], Tensor]
) -> None:
    with simulate_gpu(), pytest.raises(RuntimeError, match="device"):
        mix(*pair)


def test_numpy_reads_nothing_of_the_gpu(pair: tuple[Tensor, Tensor]) -> None:
    with simulate_gpu():
        for read in (lambda: pair[0].numpy(), lambda: np.asarray(pair[0])):
            with pytest.raises(TypeError, match="numpy"):
                read()
        np.testing.assert_array_equal(pair[0].cpu().numpy(), pair[1].numpy())


@pytest.mark.parametrize(
    "work",
    [
        lambda a, b: a + torch.tensor(2.0),
        lambda a, b: a[b.long().flip(0)],
        lambda a, b: a.new_zeros(6) + torch.ones(6, device=a.device),
        lambda a, b: a + b.to(a),
        lambda a, b: a + b.to(a.device),
        lambda a, b: torch.zeros_like(a).copy_(b),
        lambda a, b: a.sort().values + a.max(0).values,
        lambda a, b: torch.rand(6, device=a.device, generator=torch.Generator(device=a.device)),
    ],
)
def test_what_stays_on_the_gpu_is_computed(
    pair: tuple[Tensor, Tensor], work: Callable[[Tensor, Tensor], Tensor]
) -> None:
    with simulate_gpu():
        out = work(*pair)
        assert out.device == GPU
        assert out.cpu().device == torch.device("cpu")
    assert torch.equal(out.as_subclass(Tensor), work(pair[1], pair[1]).as_subclass(Tensor)) or (
        out.min() >= 0  # random numbers, of another seed
    )


def test_a_module_moves_trains_and_is_saved() -> None:
    with simulate_gpu() as gpu:
        net = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4)).to(gpu)
        optimizer = torch.optim.Adam(net.parameters())
        before = net[0].weight.detach().clone()
        net(torch.rand(5, 3, device=gpu)).square().sum().backward()
        optimizer.step()
        assert {one.device for one in net.state_dict().values()} == {gpu}
        assert not torch.equal(before, net[0].weight)
        twin = copy.deepcopy(net)
        assert {one.device for one in twin.parameters()} == {gpu}
        with pytest.raises(RuntimeError, match="same device"):
            net(torch.rand(5, 3))
        file = io.BytesIO()
        torch.save(net.state_dict(), file)
        file.seek(0)
    kept = torch.load(file, weights_only=True)
    assert {type(one) for one in kept.values()} == {Tensor}
    assert torch.equal(kept["0.weight"], net[0].weight.detach().as_subclass(Tensor))
