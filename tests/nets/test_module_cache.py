"""Values of modules: computed once, anew after a change, and gone with the module."""

import copy
import gc

import torch
from torch import nn

from posefilter.nets.cache import ModuleCache


def test_a_value_is_made_once_until_a_tensor_changes() -> None:
    cache: ModuleCache[float] = ModuleCache()
    net, made = nn.Linear(2, 2), []

    def ask(module: nn.Module = net, key: str = "sum") -> float:
        def make() -> float:
            made.append(key)
            return float(sum(one.detach().sum() for one in module.parameters()))

        return cache.get(module, module.parameters(), key, make)

    assert ask() == ask()
    assert made == ["sum"]
    ask(key="other")
    assert made == ["sum", "other"]
    with torch.no_grad():
        net.bias += 1
    before = len(made)
    assert ask() == float(net.weight.detach().sum() + net.bias.detach().sum())
    twin = copy.deepcopy(net)
    with torch.no_grad():
        twin.weight *= 3
    assert ask(twin) != ask()
    assert len(made) == before + 2


def test_values_go_with_their_module_and_when_they_are_too_many() -> None:
    cache: ModuleCache[int] = ModuleCache(max_entries=4)
    net = nn.Linear(2, 2)
    for key in range(11):
        assert cache.get(net, net.parameters(), key, lambda key=key: key) == key
        assert 1 <= len(cache._entries[net].values) <= 4
    del net
    gc.collect()
    assert not len(cache._entries)


def test_tensors_that_tell_no_change_are_never_relied_on() -> None:
    cache: ModuleCache[float] = ModuleCache()
    with torch.inference_mode():
        net = nn.Linear(1, 1)
    made = []
    for _ in range(2):
        cache.get(net, net.parameters(), 0, lambda: made.append(0) or 0.0)
    assert len(made) == 2
