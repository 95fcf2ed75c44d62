"""A simulated GPU, for machines without one: what would not run there is refused here.

Tensors that are made on `cuda:0`, or moved to it, stay in the CPU's memory and are marked. As CUDA
does, an operation then refuses tensors of both devices, except numbers (tensors without axes) and
indices on the CPU; numpy cannot read marked tensors; and a generator draws on its own device alone.
Kernels, streams, memory and types are not simulated.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, ClassVar

import pytest
import torch
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.strategies import SingleDeviceStrategy
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode, resolve_name

GPU = torch.device("cuda:0")
_Generator = torch.Generator
_ANY_DEVICE = ("to", "copy_", "tensor", "as_tensor", "new_tensor", "set_", "type")
_ANY_DEVICE += ("_has_compatible_shallow_copy_type",)  # asked before a module's weight is moved
_WAITS = ("item", "tolist", "__bool__", "__float__", "__int__", "__index__", "nonzero", "cpu")
_SHAPED_AS = ("expand_as", "view_as", "reshape_as")  # of the other tensor, only the shape is read
_BY_INDEX = ("__getitem__", "__setitem__", "index_put_")


class Marked(Tensor):
    """A tensor in the CPU's memory that passes for one of the GPU."""

    __torch_function__ = torch._C._disabled_torch_function_impl

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Files hold plain tensors."""
        return self.detach().as_subclass(Tensor).__reduce_ex__(protocol)

    def __deepcopy__(self, memo: dict[int, Any]) -> Tensor:
        """Return a copy, which is marked too."""
        copied: Tensor = self.detach().clone().as_subclass(Marked)
        copied.requires_grad_(self.requires_grad)
        memo[id(self)] = nn.Parameter(copied) if isinstance(self, nn.Parameter) else copied
        return memo[id(self)]


class _IsGenerator(type):
    def __instancecheck__(cls, instance: Any) -> bool:
        return isinstance(instance, _Generator)


class MarkedGenerator(metaclass=_IsGenerator):
    """In place of `torch.Generator`, which cannot be given attributes: notes those of the GPU."""

    of_gpu: ClassVar[dict[int, torch.Generator]] = {}  # kept, so that no other has the address

    def __new__(cls, device: Any = "cpu") -> torch.Generator:  # type: ignore[misc]
        """Return a generator of the CPU."""
        made = _Generator("cpu")
        if _is_gpu(device):
            cls.of_gpu[id(made)] = made
        return made


class SimulatedGpu(TorchFunctionMode):
    """Marks tensors, and refuses what CUDA refuses."""

    records: ClassVar[bool] = False  # a graph, which can neither be waited for nor be sent anything

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Do an operation of torch as on a GPU.

        Raises:
            RuntimeError: It mixes devices.
            TypeError: numpy is to read a tensor of the GPU.
        """
        kwargs, name = dict(kwargs or {}), getattr(func, "__name__", "")
        if name == "_parse_to":  # of `Module.to`, which moves each tensor then
            return func(*args, **kwargs)
        if name == "__get__":
            return _read_property(func, args)
        if name in ("numpy", "__array__") and isinstance(args[0], Marked):
            raise TypeError("can't convert cuda:0 device type tensor to numpy.")
        leaves: list[Any] = []
        _collect((args, kwargs), leaves)
        tensors = [one for one in leaves if isinstance(one, Tensor)]
        devices = [one for one in leaves if isinstance(one, str | torch.device)]
        if name not in (*_ANY_DEVICE, *_SHAPED_AS):
            _check_devices(name, tensors)
        on_gpu = _find_device(name, args, "device" in kwargs, tensors, devices)
        if SimulatedGpu.records:
            _check_recorded(name, on_gpu, args, tensors)
        generator = kwargs.get("generator")
        if generator is not None and (id(generator) in MarkedGenerator.of_gpu) != on_gpu:
            raise RuntimeError(f"{name}: the generator is not of the device of the numbers")
        # marked first: what is marked with a gradient would be no leaf
        leaf = on_gpu and not tensors and kwargs.pop("requires_grad", False)
        kind = Marked if on_gpu else Tensor

        def mark(one: Any) -> Any:
            if not isinstance(one, Tensor) or isinstance(one, Marked) == on_gpu:
                return one
            if name not in ("to", "cpu", "cuda") and any(one is given for given in tensors):
                return one  # changed in place
            marked = one.as_subclass(kind)
            return marked.requires_grad_() if leaf else marked

        if any(_is_gpu(one) for one in devices):
            args, kwargs = _map(args, _to_cpu), _map(kwargs, _to_cpu)
        return _map(func(*args, **kwargs), mark)


@contextmanager
def simulate_gpu() -> Iterator[torch.device]:
    """Simulate a GPU, which is used where none is asked for, and by trainings.  -> its device."""
    future = torch.__future__
    before = future.get_overwrite_module_params_on_conversion()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "Generator", MarkedGenerator)
        for user in ("estimator", "cli.calibrate", "cli.onboard"):
            patch.setattr(f"posefilter.{user}.choose_device", lambda: str(GPU))
        patch.setattr("posefilter.cuda_graphs.capture", compute_again)
        patch.setattr("torch.cuda.is_current_stream_capturing", lambda: False)
        patch.setattr("torch.cuda.get_device_name", lambda _: "simulated")
        patch.setattr("torch.cuda.max_memory_allocated", lambda _: 0)
        patch.setattr(SingleDeviceStrategy, "root_device", property(lambda _: GPU))
        patch.setattr(CPUAccelerator, "setup_device", lambda *_: None)
        future.set_overwrite_module_params_on_conversion(True)
        try:
            with SimulatedGpu():
                yield GPU
        finally:
            future.set_overwrite_module_params_on_conversion(before)
            MarkedGenerator.of_gpu.clear()


def compute_again(
    function: Callable[..., Any], inputs: list[Tensor], generator: torch.Generator | None = None
) -> tuple[Callable[[], None], Any]:
    """Stand in for `cuda_graphs.capture`: what is replayed is computed again, into one result."""
    more = {} if generator is None else {"generator": generator}
    SimulatedGpu.records = True
    try:
        output = function(*inputs, **more)
    finally:
        SimulatedGpu.records = False

    def replay() -> None:
        found = function(*inputs, **more)
        if isinstance(output, Tensor):
            output.copy_(found)
        else:
            for old, new in zip(output, found, strict=True):
                old.copy_(new)

    return replay, output


def _is_gpu(device: Any) -> bool:
    return isinstance(device, str | torch.device) and str(device).startswith("cuda")


def _to_cpu(one: Any) -> Any:
    return "cpu" if _is_gpu(one) else one


def _collect(values: Iterable[Any], into: list[Any]) -> None:
    for one in values:
        if isinstance(one, list | tuple):
            _collect(one, into)
        elif isinstance(one, dict):
            _collect(one.values(), into)
        else:
            into.append(one)


def _map(value: Any, change: Callable[[Any], Any]) -> Any:
    if isinstance(value, torch.Size):
        return value
    if isinstance(value, dict):
        return {key: _map(one, change) for key, one in value.items()}
    if isinstance(value, list | tuple):
        items = [_map(one, change) for one in value]
        if hasattr(value, "_fields"):
            return type(value)(*items)
        return type(value)(items)
    return change(value)


def _find_device(
    name: str, args: Any, has_device: bool, tensors: list[Tensor], devices: list[Any]
) -> bool:
    """Return whether an operation's results are on the GPU."""
    if name in ("cpu", "cuda"):
        return name == "cuda"
    asked = [one for one in devices if isinstance(one, torch.device)]
    if name in _ANY_DEVICE or has_device:
        asked += [one for one in devices if isinstance(one, str) and one[:3] in ("cpu", "cud")]
    if asked:
        return _is_gpu(asked[0])
    if name == "to":
        return isinstance(tensors[-1], Marked)  # x.to(other)
    if name in ("copy_", "new_tensor", *_SHAPED_AS, *_BY_INDEX):
        return isinstance(args[0], Marked)
    return any(isinstance(one, Marked) for one in tensors)


def _check_devices(name: str, tensors: list[Tensor]) -> None:
    if name in _BY_INDEX and isinstance(tensors[0], Marked):
        tensors = [one for one in tensors if one.dtype not in (torch.int64, torch.bool)]
    if len({isinstance(one, Marked) for one in tensors if one.dim() > 0}) > 1:
        raise RuntimeError(
            f"{name}: Expected all tensors to be on the same device, but found cuda:0 and cpu"
        )


def _check_recorded(name: str, on_gpu: bool, args: Any, tensors: list[Tensor]) -> None:
    given = any(isinstance(one, Marked) for one in tensors)
    sent = on_gpu and (
        name in ("tensor", "as_tensor", "new_tensor") or (name == "to" and not given)
    )
    index = args[1] if name in _BY_INDEX else ()
    index = index if isinstance(index, tuple) else (index,)
    masked = any(isinstance(one, Tensor) and one.dtype == torch.bool for one in index)
    listed = any(isinstance(one, list) for one in index)
    if sent or masked or listed or (given and (name in _WAITS or not on_gpu)):
        raise RuntimeError(f"{name}: cannot be recorded as a CUDA graph")


def _read_property(func: Any, args: Any) -> Any:
    own = args[0]
    if not isinstance(own, Marked):
        return func(*args)
    name = _name_property(func)
    if name in ("device", "is_cuda", "is_cpu"):
        return {"device": GPU, "is_cuda": True, "is_cpu": False}[name]
    out = func(*args)
    plain = isinstance(out, Tensor) and not isinstance(out, Marked)
    return out.as_subclass(Marked) if plain else out


@cache  # torch's own search of the name takes longer than most properties
def _name_property(func: Any) -> str:
    return (resolve_name(func) or "..").split(".")[-2]
