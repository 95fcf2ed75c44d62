"""Take, replace and merge the images of traces, and keep the last of their steps."""

from collections.abc import Callable
from typing import Any

from torch import Tensor

from posefilter.types import Trace


def map_tensors(change: Callable[..., Tensor], *values: Any) -> Any:
    """Return nested tuples each of whose tensors is made of the same one of all that are given.

    What belongs to no image, a number or a tensor of no dimension, stays as the first has it.

    Args:
        change: Given a tensor of each, images first.
        *values: Tuples of one form.
    """
    first = values[0]
    if isinstance(first, Tensor):
        return first if first.dim() == 0 else change(*values)
    if isinstance(first, tuple):
        fields = [map_tensors(change, *field) for field in zip(*values, strict=True)]
        return type(first)(*fields) if hasattr(first, "_fields") else tuple(fields)
    return first


def map_traces(change: Callable[..., Tensor], *traces: Trace) -> Trace:
    """Return a trace made of traces by `map_tensors`; the encoding stays that of the first."""
    bare = [trace._replace(encoding=None) for trace in traces]
    out: Trace = map_tensors(change, *bare)
    return out._replace(encoding=traces[0].encoding)


def keep_last_step(trace: Trace) -> Trace:
    """Return a trace of which particles, outputs and steps are the last alone."""
    return trace._replace(
        particles=trace.particles[-1:], outputs=trace.outputs[-1:], steps=trace.steps[-1:]
    )
