"""Muon: momentum whose matrices are made orthogonal before each step (Jordan et al. 2024), AdamW
for the rest.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from posefilter.nets.layers import fast_bfloat16


class Muon(Optimizer):
    """Orthogonalized momentum for the matrices and kernels within networks; AdamW for vectors and
    the layers at either end.

    Every direction of a layer is then learned at the same pace, also those that few samples speak
    for. Kernels count as matrices (outputs, rest). Steps have the size that AdamW's would (0.2 x
    sqrt of the larger side; Liu et al. 2025).

    parameters: (name, parameter) pairs; lr, momentum: of the matrices; adam_lr, betas, eps: of the
    rest; weight_decay: of both; spared: names of layers that AdamW trains, such as the first and
    the last of each network.
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
        spared: Sequence[str] = (),
    ) -> None:
        matrices: list[Tensor] = []
        rest: list[Tensor] = []
        for name, parameter in parameters:
            plain = parameter.dim() < 2 or bool(set(name.split(".")) & set(spared))
            (rest if plain else matrices).append(parameter)
        common = {
            "weight_decay": weight_decay,
            "momentum": momentum,
            "betas": tuple(betas),
            "eps": eps,
        }
        groups: list[dict[str, Any]] = [
            {"params": matrices, "lr": lr, "orthogonal": True},
            {"params": rest, "lr": adam_lr, "orthogonal": False},
        ]
        super().__init__([group for group in groups if group["params"]], common)

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        """Take one step."""
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
        for p in parameters:
            assert p.grad is not None
            mean = self.state[p].setdefault("momentum", torch.zeros_like(p))
            mean.lerp_(p.grad, 1 - group["momentum"])
            ahead = p.grad.lerp(mean, group["momentum"]).flatten(1)  # Nesterov
            alike.setdefault(ahead.shape, []).append((p, ahead))
        for shape, pairs in alike.items():
            size = group["lr"] * 0.2 * max(shape) ** 0.5
            for (p, _), update in zip(
                pairs, orthogonal(torch.stack([u for _, u in pairs])), strict=True
            ):
                p.mul_(1 - group["lr"] * group["weight_decay"]).sub_(
                    update.reshape(p.shape), alpha=size
                )

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


def orthogonal(matrices: Tensor, steps: int = 5) -> Tensor:
    """Return matrices of the same singular vectors whose singular values are about 1 (0.7 to 1.2).
    (M, a, b) -> (M, a, b).

    Newton-Schulz iterations of a quintic whose slope at zero is steep (Jordan et al. 2024): in
    bfloat16 where that is fast.
    """
    x = matrices / matrices.norm(dim=(1, 2), keepdim=True).clamp_min(1e-12)
    tall = x.shape[1] > x.shape[2]
    x = x.transpose(1, 2) if tall else x
    x = x.bfloat16() if fast_bfloat16(x.device) else x
    for _ in range(steps):
        gram = x @ x.transpose(1, 2)
        x = 3.4445 * x + (-4.7750 * gram + 2.0315 * gram @ gram) @ x
    return (x.transpose(1, 2) if tall else x).to(matrices.dtype)
