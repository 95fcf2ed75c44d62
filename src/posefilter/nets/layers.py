"""Layers that several networks share."""

import math

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
    return device.type == "cpu" and bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())


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
