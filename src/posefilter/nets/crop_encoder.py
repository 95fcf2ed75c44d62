"""A network that turns a crop of an RGB-D image into a code, compared by its angle to others."""

import math
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from posefilter.geometry.crops import CHANNELS
from posefilter.nets.encoding import in_bfloat16
from posefilter.nets.folded import ConvNorm

_STEEPEST = math.log(100.0)  # of the log likelihood in the cosine


class CropEncoder(nn.Module):
    """Four convolutions of stride 2 and a linear layer.

    Args:
        widths: Channels after each convolution.
        code: Width of a code.
        side: Of a crop [px], a multiple of 16.
    """

    def __init__(
        self, widths: tuple[int, int, int, int] = (24, 48, 96, 128), code: int = 64, side: int = 48
    ) -> None:
        super().__init__()
        self.side, self.width = side, code
        self.enter = ConvNorm(CHANNELS, widths[0], stride=2)
        self.trunk = nn.Sequential(*(ConvNorm(a, b, stride=2) for a, b in pairwise(widths)))
        self.out = nn.Linear(widths[-1] * math.ceil(side / 16) ** 2, code)
        self.log_scale = nn.Parameter(torch.tensor(math.log(20.0)))

    @property
    def scale(self) -> Tensor:
        """What a cosine is multiplied by to be a log likelihood, ()."""
        return self.log_scale.clamp(max=_STEEPEST).exp()

    def forward(self, crops: Tensor) -> Tensor:
        """(P, 5, side, side) -> codes of length 1 (P, width)."""
        with in_bfloat16(crops):
            x = self.trunk(self.enter(crops.contiguous(memory_format=torch.channels_last)))
            code = self.out(x.contiguous().flatten(1))
        return F.normalize(code.float(), dim=1)
