"""The networks that read one particle: multi-layer perceptrons over a latent, or a small
convolution net over a patch.
"""

from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.nets.linear import Linear


class NetOutput(NamedTuple):
    """What a particle's network says, before any of it is bounded or given a unit."""

    latent: Tensor  # (B, N, L)
    logit: Tensor  # (B, N) of the likelihood
    displacement: Tensor  # (B, N, 2)
    pose: Tensor  # (B, N, D), D = 0 where the network tells no pose


class ParticleNorm(nn.Module):
    """Normalize features over every particle of every image of the batch ("batch"), or each
    particle by itself ("layer").

    Batch statistics mix images, particles and steps, whose distributions differ; layer statistics
    do not.
    """

    def __init__(self, kind: str, width: int) -> None:
        super().__init__()
        if kind not in ("batch", "layer"):
            raise UserError(f"model.net.normalization={kind!r} is unknown: choose batch or layer")
        self.inner: nn.Module = nn.BatchNorm1d(width) if kind == "batch" else nn.LayerNorm(width)

    def forward(self, x: Tensor) -> Tensor:
        """(rows, width) -> (rows, width)."""
        return self.inner(x)


class Mlp(nn.Sequential):
    """Layers over rows: leading axes are folded into one, once: a ReLU in place on a view costs
    copies of its gradient.
    """

    def forward(self, x: Tensor) -> Tensor:
        """(*, inputs) -> (*, outputs)."""
        out: Tensor = super().forward(x.flatten(0, -2))
        return out.unflatten(0, x.shape[:-1])


def mlp(inputs: int, outputs: int, width: int, layers: int, normalization: str) -> Mlp:
    """Return `layers` linear layers, each but the last followed by a normalization and a ReLU."""
    parts: list[nn.Module] = []
    for _ in range(layers - 1):
        parts += [Linear(inputs, width), ParticleNorm(normalization, width), nn.ReLU(inplace=True)]
        inputs = width
    return Mlp(*parts, Linear(inputs, outputs))


class LatentNet(nn.Module):
    """The paper's figure 3: sight and latent give the next latent; it gives pose and likelihood;
    all three the displacement.
    """

    def __init__(
        self,
        extra: int,
        size: int,
        pose_width: int = 7,
        latent_width: int = 256,
        width: int = 512,
        layers: int = 4,
        normalization: str = "batch",
    ) -> None:
        super().__init__()
        if min(latent_width, width, layers) < 1:
            raise UserError(
                f"net: latent_width={latent_width}, width={width} and layers={layers} "
                f"must be 1 or more"
            )
        self.latent_width = latent_width
        self.latent = mlp(
            4 * size * size + extra + latent_width, latent_width, width, layers, normalization
        )
        self.pose = mlp(latent_width, pose_width, width, layers, normalization)
        self.likelihood = mlp(latent_width, 1, width, layers, normalization)
        self.displacement = mlp(pose_width + 1 + latent_width, 2, width, layers, normalization)

    def forward(self, patch: Tensor, extra: Tensor, latent: Tensor) -> NetOutput:
        """(B, N, C, k, k), (B, N, E), (B, N, L) -> NetOutput; C = 4, k = `size`, E = `extra`."""
        latent = self.latent(torch.cat([patch.flatten(2), extra, latent], dim=-1))
        pose, logit = self.pose(latent), self.likelihood(latent)
        displacement = self.displacement(torch.cat([pose, logit, latent], dim=-1))
        return NetOutput(latent, logit[..., 0], displacement, pose)


class PatchNet(nn.Module):
    """The paper's section 4.4: three Conv-BatchNorm-ReLU blocks, shared by all particles, then
    offset and likelihood.

    With `latent_width` 4 the particle also tells, as its latent, how far the box's four sides lie
    from it. `hidden` > 0 puts two layers of that width before the outputs, for the context that
    then joins the patch's features.
    """

    provides: ClassVar[Capabilities] = ("free_latent",)

    def __init__(
        self,
        extra: int,
        size: int,
        pose_width: int = 0,
        width: int = 32,
        hidden: int = 0,
        latent_width: int = 0,
        normalization: str = "batch",
    ) -> None:
        super().__init__()
        if pose_width:
            raise UserError(
                "model/net=patch tells no pose: choose model/pose_head=none, or model/net=latent"
            )
        if width < 1 or min(hidden, latent_width) < 0:
            raise UserError(
                f"net: width={width} must be 1 or more; hidden={hidden}, "
                f"latent_width={latent_width} 0 or more"
            )
        self.latent_width = latent_width
        blocks: list[nn.Module] = []
        for inputs in (4, width, width):
            norm = nn.BatchNorm2d(width) if normalization == "batch" else nn.GroupNorm(1, width)
            blocks += [nn.Conv2d(inputs, width, 3, padding=1), norm, nn.ReLU(inplace=True)]
        self.convolve = nn.Sequential(*blocks)
        features = width * size * size + extra
        outputs = 3 + latent_width
        self.tell = (
            mlp(features, outputs, hidden, 3, normalization)
            if hidden
            else Linear(features, outputs)
        )

    def forward(self, patch: Tensor, extra: Tensor, latent: Tensor) -> NetOutput:
        """(B, N, C, k, k), (B, N, E), (B, N, L) -> NetOutput; the latent is written anew, not read."""
        seen = self.convolve(patch.flatten(0, 1)).flatten(1).unflatten(0, patch.shape[:2])
        out = self.tell(torch.cat([seen, extra], dim=-1))
        return NetOutput(F.softplus(out[..., 3:] - 2), out[..., 0], out[..., 1:3], out[..., :0])
