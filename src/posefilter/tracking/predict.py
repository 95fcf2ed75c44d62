"""The predictive distribution: where the particles of the next frame start."""

import torch
from torch import Generator, Tensor

from posefilter.protocols import Encoding, Method
from posefilter.types import Batch


class FromBelief:
    """Start from given poses, and a few that the method proposes: an `Initialize`.

    With the proposals the filter is never blind to the rest of what the network sees.

    Args:
        poses: (1, N, 4, 4) draws of the predictive distribution [m].
        proposals: Number of poses that the method proposes.
    """

    def __init__(self, poses: Tensor, proposals: int) -> None:
        self.poses, self.proposals = poses, proposals

    def __call__(
        self, batch: Batch, encoding: Encoding, method: Method, particles: int, generator: Generator
    ) -> Tensor:
        """Return (1, N + proposals, 4, 4) [m]."""
        if not self.proposals:
            return self.poses
        proposed = method.propose_poses(encoding, self.proposals, generator)  # type: ignore[attr-defined]
        return torch.cat([self.poses, proposed], dim=1)
