"""Take, replace and merge the images of traces."""

from collections.abc import Callable
from typing import Any

from torch import Tensor

from posefilter.types import Trace


def map_traces(change: Callable[..., Tensor], *traces: Trace) -> Trace:
    """Return a trace each of whose tensors is made of the same one of all traces.

    What belongs to no image stays as the first has it, and so does the encoding.

    Args:
        change: Given a tensor of each trace, images first.
        traces: Runs of one filter.
    """

    def make(*parts: Any) -> Any:
        one = parts[0]
        if isinstance(one, Tensor):
            return one if one.dim() == 0 else change(*parts)
        if isinstance(one, tuple):
            made = [make(*same) for same in zip(*parts, strict=True)]
            return type(one)(*made) if hasattr(one, "_fields") else tuple(made)
        return one

    bare = [trace._replace(encoding=None) for trace in traces]
    out: Trace = make(*bare)
    return out._replace(encoding=traces[0].encoding)
