"""A network of heatmaps, which DOPE calls belief maps: for each keypoint of the object's box, where
in the image is it?
"""

import torch
from torch import Tensor, nn

from posefilter.geometry.keypoints import KEYPOINTS
from posefilter.nets.encoding import UNet, geometry, in_bfloat16, upsample_like
from posefilter.nets.layers import ResBlock

STRIDE = 4  # pixels a cell
_RARE = -4.0  # logit of a new network: hardly any cell is near a keypoint


class HeatmapNet(UNet):
    """The U-Net of the other methods with maps of stride 4.

    Args:
        widths: Channels at strides 4, 8, 16 and 32.
        width: Channels of the last block.
        depth: Whether it sees the depth; DOPE does not.
    """

    def __init__(
        self,
        widths: tuple[int, int, int, int] = (32, 80, 128, 160),
        width: int = 64,
        depth: bool = True,
    ) -> None:
        super().__init__()
        self.depth = depth
        self.build_trunk(widths)
        a, b = widths[:2]
        self.up8 = nn.Sequential(ResBlock(b), ResBlock(b))
        self.to4, self.skip4 = nn.Conv2d(b, width, 1), nn.Conv2d(a, width, 1)
        self.up4 = ResBlock(width)
        self.out = nn.Conv2d(width, KEYPOINTS, 1)
        nn.init.normal_(self.out.weight, std=0.01)
        nn.init.constant_(self.out.bias, _RARE)  # type: ignore[arg-type]

    def forward(self, rgb: Tensor, depth: Tensor, K: Tensor) -> Tensor:
        """(B, 3, H, W) in [0, 1], (B, 1, H, W) [m], (B, 3, 3) [px] -> logits (B, 9, H / 4, W / 4),
        rounded up.
        """
        shape = geometry(depth if self.depth else torch.zeros_like(depth), K)
        with in_bfloat16(rgb):
            x4, y8 = self.encode(rgb, shape)
            maps = self.out(self.up4(self.skip4(x4) + upsample_like(self.to4(y8), x4)))
        return maps.float()
