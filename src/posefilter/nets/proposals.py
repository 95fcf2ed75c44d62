"""The coordinate network: for each cell, is it the object, and which point of it?"""

from typing import ClassVar

import torch
from torch import Tensor, nn

from posefilter.capabilities import Capabilities
from posefilter.geometry.fragments import init_fragments
from posefilter.nets.coordinates import Coordinates
from posefilter.nets.encoding import UNet, geometry, in_bfloat16
from posefilter.nets.layers import ResBlock


class ObjectCoordinateNet(UNet):
    """A U-Net with residual blocks; color at full resolution, geometry (normals, depth, rays) at
    half.

    Args:
        widths: Channels at strides 4, 8, 16 and 32.
        fragments: Number of surface fragments, K.
        features: Further features of each cell, for the likelihood; None for none.
    """

    provides: ClassVar[Capabilities] = ("object_coordinates", "propose_poses", "objectness")

    centers: Tensor  # (K, 3) the fragments' centers, from the object's center, in radii
    reach: Tensor  # () their mean radius, in radii of the object; by its name in checkpoints

    def __init__(
        self,
        widths: tuple[int, int, int, int] = (32, 80, 128, 160),
        fragments: int = 64,
        features: int | None = 0,
    ) -> None:
        super().__init__()
        features = features or 0
        self.fragments = fragments
        self.register_buffer("centers", torch.zeros(fragments, 3))
        self.register_buffer("reach", torch.ones(()))
        self.build_trunk(widths)
        b = widths[1]
        self.up8 = nn.Sequential(ResBlock(b), ResBlock(b))
        self.parts = [1, fragments, 3 * fragments, features]
        self.out = nn.Conv2d(b, 1 + 4 * fragments + features, 1)
        # at first, every fragment is as likely, and its middle is the position
        nn.init.normal_(self.out.weight, std=0.01)

    def forward(self, rgb: Tensor, depth: Tensor, K: Tensor) -> Coordinates:
        """(B, 3, H, W) in [0, 1], (B, 1, H, W) [m], (B, 3, 3) [px] -> Coordinates at H / 8 x W / 8,
        rounded up.
        """
        shape = geometry(depth, K)
        with in_bfloat16(rgb):
            y = self.out(self.encode(rgb, shape)[1]).float()
        logit, share, offset, features = y.permute(0, 2, 3, 1).split(self.parts, dim=-1)
        position = self.centers + self.reach * offset.unflatten(-1, (self.fragments, 3))
        centers = self.centers.expand(len(y), -1, -1)
        return Coordinates(
            logit[..., 0], torch.log_softmax(share, dim=-1), position, centers, features
        )

    def set_object(self, points: Tensor, center: Tensor, radius: float) -> None:
        """Compute the object's fragments, unless loaded weights have theirs.

        Args:
            points: (P, 3) surface points [m].
            center: (3,) the object's center [m].
            radius: Half the diagonal of its bounding box [m].
        """
        init_fragments(self.centers, self.reach, points, center, radius)
