"""Functions of tensors that a GPU replays as CUDA graphs.

A step of the filter is hundreds of operations on small tensors, each of which takes longer to start
from Python than to compute. A graph starts them all at once. It is of fixed shapes and addresses,
so that a call copies its tensors into those of the graph, and its result out of it.
"""

import math
import threading
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import torch
from torch import Generator, Tensor

Result = Tensor | tuple[Tensor, ...]
Function = Callable[..., Any]  # -> Result

_pools: dict[int, Any] = {}  # of each GPU: graphs share their memory, as each result is copied


def applies(*tensors: Tensor) -> bool:
    """Return whether a function of these tensors may be recorded: on a GPU, without gradient."""
    return (
        tensors[0].device.type == "cuda"
        and not torch.is_grad_enabled()
        and not torch.compiler.is_compiling()
        and not torch.cuda.is_current_stream_capturing()
    )


class Recording:
    """One function at one set of shapes; its second call is recorded, and those after it replayed.

    The first is not, since many shapes are met only once.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._called = False
        self._replay: Callable[[], None] | None = None
        self._inputs: list[Tensor] = []
        self._generator: Generator | None = None  # which the graph draws from
        self._output: Result = ()
        # what was copied last, kept alive, and versions
        self._given: list[tuple[Tensor, float]] = []

    def __call__(
        self, function: Function, *tensors: Tensor, generator: Generator | None = None
    ) -> Any:
        """Return the function of the tensors: a tensor, or a tuple of them.

        Args:
            function: The same in each call but for what it closes over: it reads no number of a
                tensor, and moves none between devices.
            *tensors: All that changes from call to call; of the same shapes and types each time.
            generator: What the function draws from, which is then its argument `generator`. It
                draws the same numbers as without a recording.
        """
        with self._lock:  # threads share the graph's tensors
            return self._call(function, tensors, generator)

    def _call(
        self, function: Function, tensors: tuple[Tensor, ...], generator: Generator | None
    ) -> Result:
        if not self._called:
            self._called = True
            found: Result = function(*tensors, **_name(generator))
            return found
        if self._replay is None:
            self._inputs = [one.detach().clone() for one in tensors]
            if generator is not None:
                self._generator = torch.Generator(self._inputs[0].device)
            self._replay, self._output = capture(function, self._inputs, self._generator)
        else:
            for own, new, (old, version) in zip(self._inputs, tensors, self._given, strict=True):
                if new is not old or _read_version(new) != version:
                    own.copy_(new)
        self._given = [(one, _read_version(one)) for one in tensors]
        if generator is not None and self._generator is not None:
            self._generator.set_state(generator.get_state())
            self._replay()
            generator.set_state(self._generator.get_state())
        else:
            self._replay()
        if isinstance(self._output, Tensor):
            return self._output.clone()
        return tuple(one.clone() for one in self._output)


def _read_version(tensor: Tensor) -> float:
    """Return how often a tensor was changed; NaN, which equals nothing, of inference mode, where
    that is not counted.
    """
    return math.nan if tensor.is_inference() else tensor._version


def make_recordings(most: int = 32) -> Callable[[Any], Recording]:
    """Return what finds the recording of a key, or makes one; the least used of too many are
    dropped.
    """
    return lru_cache(maxsize=most)(lambda key: Recording())


def describe(*tensors: Tensor) -> tuple[Any, ...]:
    """Return what a recording is bound to: shapes, types and devices."""
    return tuple((one.shape, one.dtype, one.device) for one in tensors)


def capture(
    function: Function, inputs: list[Tensor], generator: Generator | None = None
) -> tuple[Callable[[], None], Result]:
    """Record a function.  -> what computes it of the inputs as they are then, and its result.

    A generator is its argument `generator`; a replay draws from the state that it has then.
    """
    device, more = inputs[0].device, _name(generator)
    current, side = torch.cuda.current_stream(device), torch.cuda.Stream(device)
    side.wait_stream(current)
    with torch.cuda.stream(side):
        function(*inputs, **more)  # libraries allocate at their first call, which a graph may not
    current.wait_stream(side)
    pool = _pools.setdefault(device.index or 0, torch.cuda.graph_pool_handle())
    graph = torch.cuda.CUDAGraph()
    if generator is not None:
        graph.register_generator_state(generator)
    # other threads, of a data loader, may use the GPU meanwhile
    with torch.cuda.graph(graph, pool=pool, capture_error_mode="thread_local"):
        output: Result = function(*inputs, **more)
    return graph.replay, output


def _name(generator: Generator | None) -> dict[str, Generator]:
    return {} if generator is None else {"generator": generator}
