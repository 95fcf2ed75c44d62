"""Layers that several networks share."""

import math
import platform
from functools import cache

import torch
from torch import Tensor, nn

from posefilter.nets.folded import ConvNorm
from posefilter.nets.linear import Linear


def fast_bfloat16(device: torch.device) -> bool:
    """Return whether the hardware computes in bfloat16 natively; emulation is several times
    slower.  False for a network that is traced for export, which is to run anywhere.
    """
    if torch.compiler.is_compiling():
        return False
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return device.type == "cpu" and _cpu_multiplies_bfloat16()


@cache
def _cpu_multiplies_bfloat16() -> bool:
    """Return whether the processor has instructions for products in bfloat16.

    oneDNN's own answer is not enough: on x86 it is yes wherever there is AVX-512, whose first
    generations (Skylake to Ice Lake) have no such instructions and take five times as long.
    """
    if not torch.ops.mkldnn._is_mkldnn_bf16_supported():
        return False
    x86 = platform.machine().lower() in ("x86_64", "amd64")
    return not x86 or bool(
        torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    )


def fourier(x: Tensor, octaves: int) -> Tensor:
    """Append Fourier features: sines and cosines of doubling frequencies, the first of period 2.

    (*, D) -> (*, D (1 + 2 octaves)).
    """
    angles = x[..., None] * (math.pi * 2.0 ** torch.arange(octaves, device=x.device, dtype=x.dtype))
    return torch.cat([x, angles.sin().flatten(-2), angles.cos().flatten(-2)], dim=-1)


class ResnetFC(nn.Module):
    """x + fc(relu(fc(relu(x)))) with a last layer of zeros at first (Mescheder et al. 2019)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.inner = Linear(width, width)
        self.outer = Linear(width, width)
        nn.init.zeros_(self.outer.weight)

    def forward(self, x: Tensor) -> Tensor:
        """(*, width) -> (*, width)."""
        return x + self.outer(torch.relu(self.inner(torch.relu(x))))


class ResBlock(nn.Module):
    """Two 3 x 3 convolutions with batch norm and a skip."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = ConvNorm(width, width)
        self.second = ConvNorm(width, width, relu=False)

    def forward(self, x: Tensor) -> Tensor:
        """(B, width, H, W) -> (B, width, H, W)."""
        return self.second.add_relu(self.first(x), x)
