"""Networks of one particle: multi-layer perceptrons with a latent, or a small CNN on its patch."""

from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError, check_choice
from posefilter.nets.linear import Linear


class NetOutput(NamedTuple):
    """Raw outputs of a particle's network, before heads bound and scale them."""

    latent: Tensor  # (B, N, L)
    logit: Tensor  # (B, N) of the likelihood
    displacement: Tensor  # (B, N, 2)
    pose: Tensor  # (B, N, D); D = 0 if the network predicts no pose


class ParticleNorm(nn.Module):
    """Normalization of particle features.

    "batch" normalizes over all particles of the batch, "layer" each particle by itself. Batch
    statistics mix images and steps, whose distributions differ.

    Args:
        kind: "batch" or "layer".
        width: Number of features.
    """

    def __init__(self, kind: str, width: int) -> None:
        super().__init__()
        check_choice("model.net.normalization", kind, "batch", "layer")
        self.inner: nn.Module = nn.BatchNorm1d(width) if kind == "batch" else nn.LayerNorm(width)

    def forward(self, x: Tensor) -> Tensor:
        """(rows, width) -> (rows, width)."""
        return self.inner(x)


class Mlp(nn.Sequential):
    """A sequence of layers on rows: leading axes are flattened once.

    An in-place ReLU on a view would copy its gradient.
    """

    def forward(self, x: Tensor) -> Tensor:
        """(*, inputs) -> (*, outputs)."""
        out: Tensor = super().forward(x.flatten(0, -2))
        return out.unflatten(0, x.shape[:-1])


def mlp(
    inputs: int,
    outputs: int,
    width: int,
    layers: int,
    normalization: str,
    last_layer: str = "linear",
) -> Mlp:
    """Return `layers` linear layers, each followed by a normalization and a ReLU; the last only if
    `last_layer` is "relu".
    """
    parts: list[nn.Module] = []
    for size in [width] * (layers - 1) + [outputs]:
        parts += [Linear(inputs, size), ParticleNorm(normalization, size), nn.ReLU(inplace=True)]
        inputs = size
    return Mlp(*parts) if last_layer == "relu" else Mlp(*parts[:-2])


class LatentNet(nn.Module):
    """The paper's figure 3: a recurrent network with a latent for each particle.

    Patch and latent give the next latent; this gives pose and likelihood; all three the
    displacement.

    Args:
        extra: Number of context features.
        size: Side of the patch.
        pose_width: Outputs of the pose head; 0 for none.
        latent_width: L.
        width: Width of hidden layers.
        layers: Linear layers of each MLP.
        normalization: "batch" or "layer".
        displacement_input: "logit" or "likelihood" (its sigmoid), beside pose and latent.
        last_layer: Of each MLP: "linear", or "relu", with normalization and ReLU as all others. No
            output is negative then, so that particles move right and down alone.

    Raises:
        UserError: A size is below 1, or `last_layer` is "relu" without batch normalization: that of
            a single output by itself is constant.
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
        displacement_input: str = "logit",
        last_layer: str = "linear",
    ) -> None:
        super().__init__()
        check_choice("model.net.displacement_input", displacement_input, "logit", "likelihood")
        check_choice("model.net.last_layer", last_layer, "linear", "relu")
        if last_layer == "relu" and normalization != "batch":
            raise UserError(
                f"model.net.last_layer=relu: needs model.net.normalization=batch, not "
                f"{normalization}, which makes a single output constant"
            )
        if min(latent_width, width, layers) < 1:
            raise UserError(
                f"net: latent_width={latent_width}, width={width} and layers={layers} "
                f"must be 1 or more"
            )
        self.displacement_input = displacement_input
        self.latent_width = latent_width
        hidden = (width, layers, normalization, last_layer)
        self.latent = mlp(4 * size * size + extra + latent_width, latent_width, *hidden)
        # layers without outputs have no gradient
        self.pose = mlp(latent_width, pose_width, *hidden) if pose_width else None
        self.likelihood = mlp(latent_width, 1, *hidden)
        self.displacement = mlp(pose_width + 1 + latent_width, 2, *hidden)

    def forward(self, patch: Tensor, extra: Tensor, latent: Tensor) -> NetOutput:
        """(B, N, C, k, k), (B, N, E), (B, N, L) -> NetOutput; C = 4, k = `size`, E = `extra`."""
        latent = self.latent(torch.cat([patch.flatten(2), extra, latent], dim=-1))
        pose = latent[..., :0] if self.pose is None else self.pose(latent)
        logit = self.likelihood(latent)
        read = logit if self.displacement_input == "logit" else torch.sigmoid(logit)
        displacement = self.displacement(torch.cat([pose, read, latent], dim=-1))
        return NetOutput(latent, logit[..., 0], displacement, pose)


class PatchNet(nn.Module):
    """The paper's section 4.4: three Conv-BatchNorm-ReLU blocks, then displacement and likelihood.

    Args:
        extra: Number of context features, which join the patch's.
        size: Side of the patch.
        pose_width: Must be 0: this network predicts no pose.
        width: Channels.
        hidden: Width of two layers before the outputs; 0 for none.
        latent_width: 4 to predict the distances to the box's four sides as the latent; 0 for none.
        normalization: "batch" or "layer".
        kernel: Side of the convolutions' kernels [px], odd; the maps keep the patch's size.
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
        kernel: int = 3,
    ) -> None:
        super().__init__()
        if kernel < 1 or kernel % 2 == 0:
            raise UserError(f"model.net.kernel={kernel}: must be odd, such as 3, 5 or 9")
        check_choice("model.net.normalization", normalization, "batch", "layer")
        if pose_width:
            raise UserError(
                "model/net=patch predicts no pose: choose model/pose_head=none, or model/net=latent"
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
            blocks += [
                nn.Conv2d(inputs, width, kernel, padding=kernel // 2),
                norm,
                nn.ReLU(inplace=True),
            ]
        self.convolve = nn.Sequential(*blocks)
        features = width * size * size + extra
        outputs = 3 + latent_width
        self.tell = (
            mlp(features, outputs, hidden, 3, normalization)
            if hidden
            else Linear(features, outputs)
        )

    def forward(self, patch: Tensor, extra: Tensor, latent: Tensor) -> NetOutput:
        """(B, N, C, k, k), (B, N, E), (B, N, L) -> NetOutput; the previous latent is not used."""
        features = self.convolve(patch.flatten(0, 1)).flatten(1).unflatten(0, patch.shape[:2])
        out = self.tell(torch.cat([features, extra], dim=-1))
        return NetOutput(F.softplus(out[..., 3:] - 2), out[..., 0], out[..., 1:3], out[..., :0])
