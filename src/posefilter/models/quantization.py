"""Small weight files: convolution kernels as 8-bit integers with a scale a channel, the rest in
half precision.

Kernels of trained networks spread so evenly that 8 bits a weight leave an error of about 1 % of a
weight's usual size, far below what training noise makes; the files are a quarter of their size in
full precision.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

_LEAST = 4096  # smaller tensors are not worth a scale
_SUFFIX = "#scale"


def pack(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the state with large kernels (3 or more dimensions) in 8 bits and other floats in half
    precision.
    """
    out: dict[str, Tensor] = {}
    for name, value in state.items():
        if value.is_floating_point() and value.dim() >= 3 and value.numel() >= _LEAST:
            scale = (
                value.abs().amax(dim=tuple(range(1, value.dim())), keepdim=True).clamp_min(1e-12)
                / 127
            )
            out[name] = (value / scale).round().to(torch.int8)
            out[name + _SUFFIX] = scale.float()
        else:
            out[name] = value.half() if value.is_floating_point() else value.clone()
    return out


def unpack(packed: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return a state in full precision; a state that was never packed comes back as it is."""
    out: dict[str, Tensor] = {}
    for name, value in packed.items():
        if name.endswith(_SUFFIX):
            continue
        scale = packed.get(name + _SUFFIX)
        whole = value.float() if value.is_floating_point() or scale is not None else value
        out[name] = whole if scale is None else whole * scale
    return out
