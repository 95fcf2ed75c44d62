"""The proposal network: it tells for each cell of the image whether it shows the object, and which point of it."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from posefilter.geometry.camera import back_project, pixel_grid, rays
from posefilter.nets.coordinates import Coordinates, spread_points
from posefilter.nets.layers import ResBlock, conv_norm, fast_bfloat16


def masked_mean_pool(depth: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Average known depth over size x size blocks.  (B, 1, H, W) [m] -> means (0 where none), share of known pixels."""
    known = (depth > 0).to(depth.dtype)
    share = F.avg_pool2d(known, size)
    return F.avg_pool2d(depth, size) / share.clamp_min(1e-6), share


def normals_from_depth(depth: Tensor, K: Tensor) -> Tensor:
    """Return surface normals towards the camera at half resolution, zeros where depth is missing.

    (B, 1, H, W) [m], (B, 3, 3) -> (B, 3, H // 2, W // 2). Central differences of the points of a 3 x 3 masked mean.
    """
    B, _, H, W = depth.shape
    z, share = masked_mean_pool(depth, 2)
    known = (share > 0).to(z.dtype)
    weight = F.avg_pool2d(known, 3, stride=1, padding=1).clamp_min(1e-6)
    z = F.avg_pool2d(z * known, 3, stride=1, padding=1) / weight * known
    grid = pixel_grid(H, W, 2, device=depth.device).reshape(1, -1, 2).expand(B, -1, -1)
    P = back_project(grid, z.flatten(1), K).transpose(1, 2).unflatten(2, (H // 2, W // 2))
    P = F.pad(P, (1, 1, 1, 1), mode="replicate")
    along_u = P[..., 1:-1, 2:] - P[..., 1:-1, :-2]
    along_v = P[..., 2:, 1:-1] - P[..., :-2, 1:-1]
    normal = torch.linalg.cross(along_v, along_u, dim=1)
    normal = normal * normal.square().sum(1, keepdim=True).clamp_min(1e-24).rsqrt()  # F.normalize is slow across channels
    ok = F.pad(known, (1, 1, 1, 1))
    ok = ok[..., 1:-1, 2:] * ok[..., 1:-1, :-2] * ok[..., 2:, 1:-1] * ok[..., :-2, 1:-1] * known
    return normal * ok


class ObjectCoordinateNet(nn.Module):
    """A U-Net with residual blocks: colour at full resolution, geometry (normals, depth, rays) at half of it.

    widths: channels at strides 4, 8, 16 and 32; fragments: parts of the surface that cells are told apart by; features: of
    each cell, for the likelihood's use. Sides must be multiples of 8; other strides are met by interpolation.
    """

    centers: Tensor  # (K, 3) the fragments' middles, over the radius, from the object's centre
    reach: Tensor  # () their mean reach, over the radius

    def __init__(
        self, widths: tuple[int, int, int, int] = (32, 80, 128, 160), fragments: int = 64, features: int = 0
    ) -> None:
        super().__init__()
        self.fragments = fragments
        self.register_buffer("centers", torch.zeros(fragments, 3))
        self.register_buffer("reach", torch.ones(()))
        a, b, c, d = widths
        self.colour = conv_norm(3, 24, stride=2)
        self.enter = conv_norm(24 + 7, a, stride=2)
        self.down4 = ResBlock(a)
        self.down8 = nn.Sequential(conv_norm(a, b, 2), ResBlock(b))
        self.down16 = nn.Sequential(conv_norm(b, c, 2), ResBlock(c), ResBlock(c))
        self.down32 = nn.Sequential(conv_norm(c, d, 2), ResBlock(d), ResBlock(d))
        self.to16, self.up16 = nn.Conv2d(d, c, 1), ResBlock(c)
        self.to8, self.up8 = nn.Conv2d(c, b, 1), nn.Sequential(ResBlock(b), ResBlock(b))
        self.parts = [1, fragments, 3 * fragments, features]
        self.out = nn.Conv2d(b, 1 + 4 * fragments + features, 1)
        nn.init.normal_(self.out.weight, std=0.01)  # at first, every fragment is as likely, and its middle is the place

    def forward(self, rgb: Tensor, depth: Tensor, K: Tensor) -> Coordinates:
        """(B, 3, H, W) in [0, 1], (B, 1, H, W) [m], (B, 3, 3) [px] -> Coordinates at H / 8 x W / 8."""
        geometry = self._geometry(depth, K)
        with torch.autocast(rgb.device.type, torch.bfloat16, enabled=fast_bfloat16(rgb.device)):
            x = self.colour((rgb * 2 - 1).contiguous(memory_format=torch.channels_last))
            x8 = self.down8(self.down4(self.enter(torch.cat([x, geometry], dim=1))))
            x16 = self.down16(x8)
            x32 = self.down32(x16)
            y16 = self.up16(x16 + self._grow(self.to16(x32), x16))
            y = self.out(self.up8(x8 + self._grow(self.to8(y16), x8))).float()
        logit, share, offset, features = y.permute(0, 2, 3, 1).split(self.parts, dim=-1)
        place = self.centers + self.reach * offset.unflatten(-1, (self.fragments, 3))
        centers = self.centers.expand(len(y), -1, -1)
        return Coordinates(logit[..., 0], torch.log_softmax(share, dim=-1), place, centers, features)

    def adopt(self, points: Tensor, center: Tensor, radius: float) -> None:
        """Cut an object into fragments, once: what was learned is about these, whatever points it is judged by later.

        (P, 3) surface points [m], (3,) and half the diagonal of its bounding box [m].
        """
        if bool(self.centers.any()):
            return
        middles, reach = spread_points((points - center) / radius, self.fragments)
        self.centers.copy_(middles)
        self.reach.fill_(reach)

    @staticmethod
    def _geometry(depth: Tensor, K: Tensor) -> Tensor:
        B, _, H, W = depth.shape
        z, share = masked_mean_pool(depth, 2)
        grid = pixel_grid(H, W, 2, device=depth.device).reshape(1, -1, 2).expand(B, -1, -1)
        view = rays(grid, K)[..., :2].transpose(1, 2).unflatten(2, z.shape[-2:])
        near = (z - 1.0).clamp(-1.0, 1.5) * (share > 0)
        return torch.cat([normals_from_depth(depth, K), near, share, view], dim=1)

    @staticmethod
    def _grow(x: Tensor, like: Tensor) -> Tensor:
        return F.interpolate(x, size=like.shape[-2:], mode="bilinear", align_corners=False)
