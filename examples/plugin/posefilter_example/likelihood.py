"""A likelihood for pose_pf that is linear in each point's place and color."""

import torch
from torch import Generator, Tensor, nn

from posefilter.nets.likelihood import Pixels, sample_points


class LinearLikelihood(nn.Module):
    """The mean of a linear function of the points that a pose looks at."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Linear(6, 1)

    def forward(
        self, image: Pixels, poses: Tensor, sigma: Tensor, center: Tensor, radius: float,
        pixels: int, generator: Generator,
    ) -> Tensor:  # fmt: skip
        """Score poses (B, N, 4, 4) from so many image points each -> (B, N)."""
        noise = torch.randn(len(poses), 1, pixels, 2, generator=generator, device=poses.device)
        points = sample_points(image, poses, center, radius, noise)
        judged: Tensor = self.net(torch.cat([points.position / radius, points.color], dim=-1))
        return judged[..., 0].mean(-1)
