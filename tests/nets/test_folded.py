"""Convolutions with folded batch norm: the layers' own numbers, and no others once these change."""

import copy

import pytest
import torch
from torch import Tensor, nn

from posefilter.nets.folded import ConvNorm
from posefilter.nets.layers import ResBlock
from posefilter.nets.linear import has_onednn

NETS = {
    "plain": lambda: ConvNorm(5, 16),
    "halving": lambda: ConvNorm(5, 16, stride=2),
    "linear": lambda: ConvNorm(5, 16, relu=False),
    "skip": lambda: nn.Sequential(ConvNorm(5, 16), ResBlock(16)),
}


def make(name: str) -> nn.Module:
    """A network whose batch norm has seen data, and whose factors are not 1."""
    torch.manual_seed(2)
    net = NETS[name]()
    for part in net.modules():
        if isinstance(part, nn.BatchNorm2d):
            nn.init.normal_(part.weight, 1.0, 0.3)
            nn.init.normal_(part.bias)
            nn.init.normal_(part.running_mean)
            nn.init.uniform_(part.running_var, 0.3, 3.0)
    return net.eval()


def image(height: int = 15, width: int = 18) -> Tensor:
    return torch.randn(2, 5, height, width, generator=torch.Generator().manual_seed(0))


def reference(net: nn.Module, x: Tensor) -> Tensor:
    with torch.enable_grad():
        return net(x).detach()


@pytest.mark.parametrize("name", NETS)
def test_both_ways_agree(name: str) -> None:
    net, x = make(name), image()
    exact = reference(net, x)
    with torch.no_grad():
        torch.testing.assert_close(net(x), exact, rtol=1e-5, atol=1e-5)
        with torch.autocast("cpu", torch.bfloat16):
            half = net(x)
    assert (half.float() - exact).abs().mean() < 0.01 * exact.abs().mean()


@pytest.mark.skipif(not has_onednn(), reason="nothing is folded without oneDNN")
def test_folds_only_without_gradient_outside_training() -> None:
    net, x = ConvNorm(5, 16).eval(), image()
    assert not net.folds(x)
    with torch.no_grad():
        assert net.folds(x)
        assert not net.folds(x.double())
        assert not net.train().folds(x)
        assert not net.eval().double().folds(x)


@pytest.mark.parametrize("name", NETS)
def test_changed_parameters_are_seen(name: str) -> None:
    net, x = make(name), image()
    with torch.no_grad():
        before = net(x)
        for changed in [n for n, _ in net.named_parameters()]:
            net.get_parameter(changed).mul_(1.5)
            torch.testing.assert_close(net(x), reference(net, x), rtol=1e-5, atol=1e-5)
        net.train()(x)  # the statistics
        torch.testing.assert_close(net.eval()(x), reference(net, x), rtol=1e-5, atol=1e-5)
        other = make(name)
        net.load_state_dict(other.state_dict())
        torch.testing.assert_close(net(x), before)


def test_a_copy_changes_by_itself() -> None:
    net, x = make("skip"), image()
    with torch.no_grad():
        before = net(x)
        twin = copy.deepcopy(net)
        for parameter in twin.parameters():
            parameter.add_(0.1)
        torch.testing.assert_close(twin(x), reference(twin, x), rtol=1e-5, atol=1e-5)
        assert torch.equal(net(x), before)


def test_keeps_names_and_order_of_parameters() -> None:
    names = ["0.weight", "1.weight", "1.bias", "1.running_mean", "1.running_var"]
    assert [*ConvNorm(5, 16).state_dict()] == [*names, "1.num_batches_tracked"]


@pytest.mark.skipif(not has_onednn(), reason="nothing is folded without oneDNN")
@pytest.mark.parametrize("size", [(8, 10), (15, 20), (6, 6)])
def test_weights_lie_as_they_are_used(size: tuple[int, int], capfd: pytest.CaptureFixture) -> None:
    """Bringing these weights into another order takes forty times as long as the convolution."""
    net = ConvNorm(160, 160).eval()
    x = torch.randn(1, 160, *size)
    with torch.no_grad():
        net(x)
        with torch.backends.mkldnn.verbose(torch.backends.mkldnn.VERBOSE_ON):
            net(x)
    lines = [line for line in capfd.readouterr().out.splitlines() if ",exec," in line]
    assert any("convolution" in line for line in lines)
    assert not [line for line in lines if "reorder" in line and "160x160x3x3" in line]


def test_sizes_one_after_another() -> None:
    net = make("skip")
    for side in [15, 16, 17, 18, 19, 20, 21, 22, 15]:
        x = image(side, side + 1)
        exact = reference(net, x)
        with torch.no_grad():
            torch.testing.assert_close(net(x), exact, rtol=1e-5, atol=1e-5)
