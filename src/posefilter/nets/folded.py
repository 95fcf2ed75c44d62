"""Convolutions with batch norm without gradient, by one operation each.

Outside training batch norm is a factor and a summand for each channel, which belong into the
convolution's weights. oneDNN adds a skip and takes ReLU while it writes the result. The numbers are
those of the layers themselves up to rounding. The folded weights are kept in the order that oneDNN
works in, which it would otherwise bring them into at each call: of a small image that is most of
the time. That order depends on the processor and on the image's size.
"""

import torch
from torch import Tensor, nn

from posefilter.nets.cache import ModuleCache
from posefilter.nets.linear import list_onednn_types

_LAST = torch.channels_last
_FUSES = hasattr(torch.ops.mkldnn, "_convolution_pointwise")
_TYPES = list_onednn_types() if _FUSES else ()
_reorder = getattr(torch._C._nn, "mkldnn_reorder_conv2d_weight", None)


def _find_dtype() -> torch.dtype:
    """Return what a convolution on the CPU computes in: float32, or what autocast says."""
    half = torch.is_autocast_enabled("cpu")
    return torch.get_autocast_dtype("cpu") if half else torch.float32


class ConvNorm(nn.Sequential):
    """A convolution without bias, with zeros at its borders, batch norm, and ReLU if asked for.

    Batch norm's statistics do not depend on the image's size: training uses crops, evaluation whole
    images.

    Args:
        inputs: Channels of the input.
        outputs: Channels of the output.
        stride: Of the convolution.
        relu: Whether ReLU follows.
    """

    def __init__(self, inputs: int, outputs: int, stride: int = 1, relu: bool = True) -> None:
        conv = nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False)
        norm = nn.BatchNorm2d(outputs)
        super().__init__(conv, norm, *([nn.ReLU(inplace=True)] if relu else []))
        self._layers = conv, norm  # looked up without nn.Module's detours
        self._then = "relu" if relu else "none"
        self._where = [1, 1], [stride, stride], [1, 1], 1  # padding, stride, dilation, groups

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, outputs, H / stride, W / stride), rounded up."""
        if not self.folds(x):
            out: Tensor = super().forward(x)
            return out
        return self._convolve(x, None)

    def add_relu(self, x: Tensor, skip: Tensor) -> Tensor:
        """Return relu(skip + self(x)), for a module without a ReLU of its own."""
        if not self.folds(x):
            return torch.relu(skip + self(x))
        return self._convolve(x, skip)

    def folds(self, x: Tensor) -> bool:
        """Return whether the folded convolution applies: without gradient and outside training, on
        a CPU, float32 or by autocast bfloat16 where oneDNN has it, not traced for export.
        """
        if torch.is_grad_enabled() or self.training or torch.compiler.is_compiling():
            return False
        weight = self._layers[0].weight
        plain = x.device.type == weight.device.type == "cpu" and x.numel() > 0
        types = weight.dtype == torch.float32 and x.dtype in (torch.float32, torch.bfloat16)
        # nothing tells whether a tensor of inference mode has changed
        return _find_dtype() in _TYPES and plain and types and not weight.is_inference()

    def _convolve(self, x: Tensor, skip: Tensor | None) -> Tensor:
        dtype = _find_dtype()
        weight, bias = self._fold(dtype, x.shape)
        x = x.to(dtype).contiguous(memory_format=_LAST)
        convolve = torch.ops.mkldnn._convolution_pointwise
        out: Tensor
        if skip is None:
            out = convolve(x, weight, bias, *self._where, self._then, [], "")
            return out
        skip = skip.to(dtype).contiguous(memory_format=_LAST)
        out = convolve.binary(x, skip, weight, bias, *self._where, "add", 1.0, "relu", [], "")
        return out

    def _fold(self, dtype: torch.dtype, shape: torch.Size) -> tuple[Tensor, Tensor]:
        """Return weight and bias with batch norm in them, in the order that oneDNN works in for an
        input of that shape.
        """
        conv, norm = self._layers
        mean, variance, count = norm.running_mean, norm.running_var, norm.num_batches_tracked
        assert mean is not None
        assert variance is not None
        assert count is not None
        # training updates the statistics without a new version, but it counts its batches
        parts = (conv.weight, norm.weight, norm.bias, mean, variance, count)

        def fold() -> tuple[Tensor, Tensor]:
            gain = norm.weight.detach() * (variance + norm.eps).rsqrt()
            bias = norm.bias.detach() - mean * gain
            weight = (conv.weight.detach() * gain[:, None, None, None]).to(dtype)
            return weight.contiguous(memory_format=_LAST), bias.to(dtype)

        def order() -> tuple[Tensor, Tensor]:
            weight, bias = CACHE.get(self, parts, dtype, fold)
            if _reorder is not None:
                weight = _reorder(weight.to_mkldnn(), *self._where, list(shape))
            return weight, bias

        return CACHE.get(self, parts, (dtype, shape), order)


# a window's size changes with the object's distance: few are kept, since each has all weights
CACHE: ModuleCache[tuple[Tensor, Tensor]] = ModuleCache(max_entries=6)
