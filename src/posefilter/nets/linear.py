"""A linear layer that uses oneDNN, which for float32 is faster than MKL on AMD's processors."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable


def has_onednn() -> bool:
    """Return whether this build of PyTorch can multiply float32 matrices with oneDNN."""
    return torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")


def list_onednn_types() -> tuple[torch.dtype, ...]:
    """Return the types that oneDNN computes in on this processor: bfloat16 needs AVX-512."""
    if not has_onednn():
        return ()
    half = torch.ops.mkldnn._is_mkldnn_bf16_supported()
    return (torch.float32, torch.bfloat16) if half else (torch.float32,)


_ONEDNN = has_onednn()


class Linear(nn.Linear):
    """nn.Linear computed by oneDNN where available: the same parameters and, up to rounding,
    outputs.
    """

    def forward(self, x: Tensor) -> Tensor:
        """(*, inputs) -> (*, outputs)."""
        if not takes_onednn(x, self.weight):
            return F.linear(x, self.weight, self.bias)
        out: Tensor = _OneDnnLinear.apply(x.reshape(-1, x.shape[-1]), self.weight, self.bias)
        return out.view(*x.shape[:-1], out.shape[-1])


def takes_onednn(x: Tensor, weight: Tensor) -> bool:
    """Return whether oneDNN applies: float32 on the CPU, not empty, no autocast to another type,
    not traced for export.
    """
    if torch.compiler.is_compiling():
        return False
    plain = x.device.type == "cpu" and x.dtype == weight.dtype == torch.float32 and x.numel() > 0
    return _ONEDNN and plain and not torch.is_autocast_enabled("cpu")


class _OneDnnLinear(torch.autograd.Function):
    """x W^T + b and its gradients, one matrix product each."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        """(rows, inputs), (outputs, inputs), (outputs,) -> (rows, outputs)."""
        ctx.save_for_backward(x, weight)
        return _times(x, weight, bias)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
        """Return the gradients that are needed."""
        x, weight = ctx.saved_tensors
        of_x, of_weight, of_bias = ctx.needs_input_grad
        return (
            _times(grad, weight.t()) if of_x else None,
            _times(grad.t(), x.t()) if of_weight else None,
            grad.sum(0) if of_bias else None,
        )


def _times(a: Tensor, b: Tensor, bias: Tensor | None = None) -> Tensor:
    """A B^T + bias.  (m, k), (n, k), (n,) -> (m, n)."""
    out: Tensor = torch.ops.mkldnn._linear_pointwise(a, b, bias, "none", [], "")
    return out
