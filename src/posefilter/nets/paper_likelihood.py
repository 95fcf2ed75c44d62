"""The paper's likelihood network M (table 1): a score for each colored point in the object
frame.
"""

from typing import ClassVar

import torch
from torch import Generator, Tensor, nn

from posefilter.capabilities import Capabilities
from posefilter.errors import check_choice
from posefilter.nets.layers import ResnetFC
from posefilter.nets.likelihood import SPREAD, Pixels, Points, sample_points
from posefilter.nets.linear import Linear


class PaperLikelihood(nn.Module):
    """The sum of M over a pose's pixels.  M: Linear 6 -> 128, five ResnetFC of 128, Linear 128 ->
    1.

    It has no input for viewing ray or noise level. The paper does not specify `spread`, nor pixels
    off the frame or without depth, which add nothing here.

    Args:
        width: Width of M.
        blocks: Its number of residual blocks.
        spread: Standard deviation of the pixels, in projected radii.
        anchor: Where the pixels are drawn about: "origin" of the hypothesis's frame, which is that
            of the mesh file, or "center" of the mesh.
    """

    provides: ClassVar[Capabilities] = ("score_points", "score_samples")

    def __init__(
        self, width: int = 128, blocks: int = 5, spread: float = SPREAD, anchor: str = "center"
    ) -> None:
        super().__init__()
        check_choice("model.likelihood.anchor", anchor, "origin", "center")
        self.anchor = anchor
        self.spread = spread
        self.net = nn.Sequential(
            Linear(6, width), *[ResnetFC(width) for _ in range(blocks)], nn.Linear(width, 1)
        )

    def score_samples(self, position: Tensor, color: Tensor) -> Tensor:
        """Score points.

        Args:
            position: (*, 3) in the frame of the mesh [m].
            color: (*, 3) in [0, 1].

        Returns:
            Scores (*).
        """
        return self.net(torch.cat([position, color], dim=-1))[..., 0]

    def score_points(self, points: Points, sigma: float, center: Tensor, radius: float) -> Tensor:
        """Score points one by one; `sigma` and `radius` are not used.  Points (B, N, P) -> (B, N,
        P).
        """
        return self.score_samples(points.position + center, points.color)

    def forward(
        self,
        image: Pixels,
        poses: Tensor,
        sigma: Tensor,
        center: Tensor,
        radius: float,
        pixels: int,
        generator: Generator,
    ) -> Tensor:
        """Score poses.  poses (B, N, 4, 4) -> (B, N); `sigma` is not used."""
        noise = torch.randn(*poses.shape[:2], pixels, 2, generator=generator, device=poses.device)
        anchor = torch.zeros_like(center) if self.anchor == "origin" else None
        with torch.autocast(poses.device.type, enabled=False):
            points = sample_points(image, poses, center, radius, noise, self.spread, anchor)
            scores = self.score_samples(points.position + center, points.color)
        return torch.where(points.inside & points.known, scores, 0.0).sum(-1)
