"""Muon: orthogonalized momentum for matrices (Jordan et al. 2024), AdamW for the rest."""

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from posefilter.nets.layers import fast_bfloat16


class Muon(Optimizer):
    """Orthogonalized momentum for hidden matrices and convolution kernels, AdamW for the rest.

    All directions of a layer are learned at the same rate, also those of rare samples. A kernel is
    a matrix (outputs, rest). Steps have the size of AdamW's: 0.2 x sqrt of the larger side (Liu et
    al. 2025).

    `torch.optim.Muon` is not used, since it refuses parameters that are not 2-D, among them the 4-D
    kernels of convolutions, and has no AdamW for the other parameters. This one also batches the
    iterations of matrices of one shape.

    Args:
        parameters: (name, parameter) pairs.
        lr: Learning rate of the matrices.
        momentum: Momentum of the matrices.
        adam_lr: Learning rate of the other parameters.
        betas: Decay rates of AdamW.
        eps: Of AdamW.
        weight_decay: Of all parameters, decoupled.
        adam_layers: Layers that AdamW trains, such as the first and the last of each network: a
            parameter is one of them where a part of its dotted name is in here.
    """

    def __init__(
        self,
        parameters: Iterable[tuple[str, Tensor]],
        lr: float = 2e-3,
        momentum: float = 0.95,
        adam_lr: float = 6e-4,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        weight_decay: float = 1e-3,
        adam_layers: Sequence[str] = (),
    ) -> None:
        matrices: list[Tensor] = []
        adam_parameters: list[Tensor] = []
        for name, parameter in parameters:
            plain = parameter.dim() < 2 or bool(set(name.split(".")) & set(adam_layers))
            (adam_parameters if plain else matrices).append(parameter)
        common = {
            "weight_decay": weight_decay,
            "momentum": momentum,
            "betas": tuple(betas),
            "eps": eps,
        }
        groups: list[dict[str, Any]] = [
            {"params": matrices, "lr": lr, "orthogonal": True},
            {"params": adam_parameters, "lr": adam_lr, "orthogonal": False},
        ]
        super().__init__([group for group in groups if group["params"]], common)

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        """Update all parameters; `closure`, if given, computes the loss anew and returns it."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            parameters = [p for p in group["params"] if p.grad is not None]
            (self._orthogonal_step if group["orthogonal"] else self._adam_step)(parameters, group)
        return loss

    def _orthogonal_step(self, parameters: list[Tensor], group: dict[str, Any]) -> None:
        alike: dict[torch.Size, list[tuple[Tensor, Tensor]]] = {}
        for p in _list_moved(parameters):
            assert p.grad is not None
            mean = self.state[p].setdefault("momentum", torch.zeros_like(p))
            mean.lerp_(p.grad, 1 - group["momentum"])
            ahead = p.grad.lerp(mean, group["momentum"]).flatten(1)  # Nesterov
            alike.setdefault(ahead.shape, []).append((p, ahead))
        for shape, pairs in alike.items():
            size = group["lr"] * 0.2 * max(shape) ** 0.5
            updates = orthogonalize(torch.stack([ahead for _, ahead in pairs]))
            for (p, _), update in zip(pairs, updates, strict=True):
                p.mul_(1 - group["lr"] * group["weight_decay"])
                p.sub_(update.reshape(p.shape), alpha=size)

    def _adam_step(self, parameters: list[Tensor], group: dict[str, Any]) -> None:
        first, second = group["betas"]
        for p in parameters:
            assert p.grad is not None
            state = self.state[p]
            if not state:
                state.update(
                    step=torch.zeros(()), mean=torch.zeros_like(p), square=torch.zeros_like(p)
                )
            state["step"] += 1
            t = float(state["step"])
            state["mean"].lerp_(p.grad, 1 - first)
            state["square"].lerp_(p.grad.square(), 1 - second)
            spread = (state["square"] / (1 - second**t)).sqrt_().add_(group["eps"])
            p.mul_(1 - group["lr"] * group["weight_decay"])
            p.addcdiv_(state["mean"], spread, value=-group["lr"] / (1 - first**t))


def _list_moved(parameters: list[Tensor]) -> list[Tensor]:
    """Return those of the parameters whose gradient is not zero throughout.

    Orthogonalized, what is left of the momentum would be a step of full size: a loss of weight 0
    must move nothing.
    """
    if not parameters:
        return parameters
    largest = torch.stack([p.grad.abs().amax() for p in parameters if p.grad is not None])
    return [p for p, any_ in zip(parameters, (largest != 0).tolist(), strict=True) if any_]


def orthogonalize(matrices: Tensor, steps: int = 5) -> Tensor:
    """Orthogonalize matrices approximately: singular values become about 1 (0.7 to 1.2).

    Newton-Schulz iterations of a quintic (Jordan et al. 2024), in bfloat16 where that is fast.

    Args:
        matrices: (M, a, b).
        steps: Iterations.

    Returns:
        (M, a, b), with the same singular vectors.
    """
    x = matrices / matrices.norm(dim=(1, 2), keepdim=True).clamp_min(1e-12)
    tall = x.shape[1] > x.shape[2]
    x = x.transpose(1, 2) if tall else x
    x = x.bfloat16() if fast_bfloat16(x.device) else x
    for _ in range(steps):
        gram = x @ x.transpose(1, 2)
        x = 3.4445 * x + (-4.7750 * gram + 2.0315 * gram @ gram) @ x
    return (x.transpose(1, 2) if tall else x).to(matrices.dtype)
