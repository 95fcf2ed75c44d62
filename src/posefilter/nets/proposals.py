"""Proposals: a dense network tells for each cell of the image whether it shows the object, and which point of it.

Cells with their measured 3-D points then vote for poses: a few cells near each other fix a rigid transform (Kabsch).
The idea of dense object coordinates: Brachmann et al. 2014; of the fit: Kabsch 1976.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Generator, Tensor, nn

from posefilter.geometry.camera import back_project, pixel_grid, rays
from posefilter.geometry.pose import fit_rigid
from posefilter.nets.layers import ResBlock, conv_norm, fast_bfloat16

STRIDE = 8  # pixels a cell


class Coordinates(NamedTuple):
    """What the network says of each of the h x w cells."""

    logit: Tensor  # (B, h, w) is it the object
    coordinate: Tensor  # (B, h, w, 3) object point, over the radius, from the object's centre
    log_scale: Tensor  # (B, h, w) log of the Laplace scale of `coordinate`


class Cells(NamedTuple):
    """The measured side of each cell."""

    point: Tensor  # (B, h, w, 3) camera point [m]
    valid: Tensor  # (B, h, w) bool: depth is known there


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
    normal = F.normalize(torch.linalg.cross(along_v, along_u, dim=1), dim=1)
    ok = F.pad(known, (1, 1, 1, 1))
    ok = ok[..., 1:-1, 2:] * ok[..., 1:-1, :-2] * ok[..., 2:, 1:-1] * ok[..., :-2, 1:-1] * known
    return normal * ok


class ObjectCoordinateNet(nn.Module):
    """A U-Net with residual blocks: colour at full resolution, geometry (normals, depth, rays) at half of it.

    widths: channels at strides 4, 8, 16 and 32. Sides must be multiples of 8; other strides are met by interpolation.
    """

    def __init__(self, widths: tuple[int, int, int, int] = (32, 80, 128, 160)) -> None:
        super().__init__()
        a, b, c, d = widths
        self.colour = conv_norm(3, 24, stride=2)
        self.enter = conv_norm(24 + 7, a, stride=2)
        self.down4 = ResBlock(a)
        self.down8 = nn.Sequential(conv_norm(a, b, 2), ResBlock(b))
        self.down16 = nn.Sequential(conv_norm(b, c, 2), ResBlock(c), ResBlock(c))
        self.down32 = nn.Sequential(conv_norm(c, d, 2), ResBlock(d), ResBlock(d))
        self.to16, self.up16 = nn.Conv2d(d, c, 1), ResBlock(c)
        self.to8, self.up8 = nn.Conv2d(c, b, 1), nn.Sequential(ResBlock(b), ResBlock(b))
        self.out = nn.Conv2d(b, 5, 1)

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
        return Coordinates(y[:, 0], y[:, 1:4].permute(0, 2, 3, 1), y[:, 4].clamp(-5.0, 1.0))

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


def measure_cells(depth: Tensor, K: Tensor) -> Cells:
    """Lift each cell's central measured depth to a camera point.  (B, 1, H, W) [m], (B, 3, 3) -> Cells.

    The median of the four central pixels' known depths would mix surfaces at edges; the largest-depth-first pick of one
    pixel does not, so a cell takes the known central pixel nearest to its centre.
    """
    B, _, H, W = depth.shape
    h, w = H // STRIDE, W // STRIDE
    blocks = depth[:, 0, : h * STRIDE, : w * STRIDE].unflatten(1, (h, STRIDE)).unflatten(3, (w, STRIDE))
    center = STRIDE // 2
    choices = [(center - 1, center - 1), (center, center), (center - 1, center), (center, center - 1)]
    z = torch.zeros(B, h, w, dtype=depth.dtype, device=depth.device)
    pixel = pixel_grid(H, W, STRIDE, device=depth.device).expand(B, -1, -1, -1).clone()
    grid0 = pixel_grid(H, W, STRIDE, device=depth.device) - (STRIDE - 1) / 2
    for row, col in choices:
        candidate = blocks[:, :, row, :, col]
        take = (z == 0) & (candidate > 0)
        z = torch.where(take, candidate, z)
        offset = torch.tensor([col, row], dtype=depth.dtype, device=depth.device)
        pixel = torch.where(take[..., None], grid0 + offset, pixel)
    point = back_project(pixel.flatten(1, 2), z.flatten(1), K).unflatten(1, (h, w))
    return Cells(point, z > 0)


def coordinate_loss(
    said: Coordinates, cells: Cells, mask: Tensor, camera_from_object: Tensor, center: Tensor, radius: float
) -> tuple[Tensor, Tensor]:
    """Return the loss an image (B,) and the mean coordinate error on the object (B,) [m].

    Binary cross-entropy for `is it the object`, and the Laplace negative log-likelihood of the coordinates where it is and
    depth is known: |e|_1 / s + 3 log s. mask: (B, 1, H, W) bool.
    """
    on = mask[:, 0, STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE][:, : said.logit.shape[1], : said.logit.shape[2]]
    R, t = camera_from_object[:, None, :3, :3], camera_from_object[:, None, None, :3, 3]
    truth = ((cells.point - t) @ R - center) / radius
    inside = (on & cells.valid & (truth.norm(dim=-1) < 1.2)).float()
    bce = F.binary_cross_entropy_with_logits(said.logit, on.float(), reduction="none").mean((1, 2))
    error = (said.coordinate - truth).abs().sum(-1)
    laplace = error * torch.exp(-said.log_scale) + 3 * said.log_scale
    count = inside.sum((1, 2)).clamp_min(1.0)
    fit = (laplace * inside).sum((1, 2)) / count
    distance = ((said.coordinate - truth).norm(dim=-1) * inside).sum((1, 2)) / count * radius
    return 5 * bce + fit * (inside.sum((1, 2)) > 0), distance


def draw_poses(
    said: Coordinates, cells: Cells, center: Tensor, radius: float, count: int, generator: Generator, votes: int = 3
) -> Tensor:
    """Draw poses from the cells' votes.  -> (B, count, 4, 4) camera_from_object [m].

    A seed cell is drawn by p(object) / scale, `votes` more by the same weight within 2 radii of it; their weighted Kabsch
    fit is one pose. Where no cell of an image has a known depth the poses mean nothing.
    """
    B = len(said.logit)
    weight = (torch.sigmoid(said.logit) + 1e-4) / (said.log_scale.exp() + 0.05) * cells.valid
    weight = weight.flatten(1)
    weight = torch.where((weight > 0).any(1, keepdim=True), weight, torch.ones_like(weight))
    point, thing = cells.point.flatten(1, 2), said.coordinate.flatten(1, 2) * radius + center
    seed = torch.multinomial(weight, count, replacement=True, generator=generator)
    pick = lambda x, index: x.gather(1, index.flatten(1)[..., None].expand(-1, -1, 3)).unflatten(1, index.shape[1:])  # noqa: E731
    at = pick(point, seed)
    near = torch.cdist(at, point) < 2 * radius
    local = weight[:, None] * near + 1e-12 * (weight[:, None] > 0)
    rest = torch.multinomial(local.flatten(0, 1), votes, replacement=True, generator=generator).unflatten(0, (B, count))
    index = torch.cat([seed[..., None], rest], dim=-1)
    chosen = weight.gather(1, index.flatten(1)).unflatten(1, index.shape[1:])
    return fit_rigid(pick(thing, index), pick(point, index), chosen)
