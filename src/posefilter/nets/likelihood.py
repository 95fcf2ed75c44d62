"""The likelihood of a pose: a network judges single image points as the hypothesis would have them,
and their mean decides.

Each pose looks at pixels drawn around its projected origin, lifts them by their depth and carries
them into its object frame. A point is judged by where it lies there, its color, the viewing ray in
that frame (so that a surface seen *through* the hypothesis differs from one that hides it) and the
noise level: one network holds a family, broad to sharp.

A single pixel says little: red is red on every face. So a point may also be judged by its
*context*, what the proposal network says there: whether this is the object, how likely the part of
it that the hypothesis sees there, where exactly, and features of its own choosing that the
likelihood's loss shapes.
"""

import math
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Generator, Tensor, nn

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.geometry.camera import project, rays
from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.nets.coordinates import Context, Coordinates, ask, lay_out_context
from posefilter.nets.layers import ResnetFC, fourier
from posefilter.nets.linear import Linear


class Pixels(NamedTuple):
    """An image laid out for gathering."""

    values: Tensor  # (B, H * W, 4) red, green, blue in [0, 1], z-depth [m] (0 unknown)
    size: tuple[int, int]  # H, W
    intrinsics: Tensor  # (B, 3, 3) [px]
    context: Context | None = None  # what the proposal network says

    def first(self, count: int) -> "Pixels":
        """Return the first so many images."""
        context = None if self.context is None else self.context.first(count)
        return Pixels(self.values[:count], self.size, self.intrinsics[:count], context)


class Points(NamedTuple):
    """The image points that each pose looks at, in that pose's object frame, relative to the
    object's center.
    """

    # (B, N, P, 3) [m]; where depth is unknown, the ray's point nearest to the center
    position: Tensor
    color: Tensor  # (B, N, P, 3) in [0, 1]
    ray: Tensor  # (B, N, P, 3) unit viewing ray
    known: Tensor  # (B, N, P) bool: depth is known
    inside: Tensor  # (B, N, P) bool: the pixel lies in the frame
    context: Tensor | None = None  # (B, N, P, 5 + C), as `ask` answers


def lay_out(
    rgb: Tensor, depth: Tensor, K: Tensor, coordinates: Coordinates | None = None
) -> Pixels:
    """Lay images out for gathering.  (B, 3, H, W), (B, 1, H, W) [m], (B, 3, 3) -> Pixels.

    coordinates: what the proposal network says of them, if it is to be read.
    """
    H, W = rgb.shape[-2:]
    context = None if coordinates is None else lay_out_context(coordinates, H, W)
    values = torch.cat([rgb, depth], dim=1).flatten(2).transpose(1, 2).contiguous()
    return Pixels(values, (H, W), K, context)


def look(
    image: Pixels, poses: Tensor, center: Tensor, radius: float, noise: Tensor, spread: float = 0.6
) -> Points:
    """Gather the pixels that each pose looks at, and carry them into its object frame.

    poses (B, N, 4, 4); noise (B, 1 or N, P, 2) standard normal: pixels are the projected center +
    spread x projected radius x noise, rounded. The same noise for every pose of an image makes
    their scores comparable (common random numbers).
    """
    H, W = image.size
    K = image.intrinsics
    middle = origin_of(poses, center)
    reach = spread * radius * K[:, None, 0, 0] / middle[..., 2].clamp_min(0.1)
    pixels = (project(middle, K)[..., None, :] + reach[..., None, None] * noise).round()
    inside = (
        (pixels[..., 0] >= 0) & (pixels[..., 0] < W) & (pixels[..., 1] >= 0) & (pixels[..., 1] < H)
    )
    u, v = pixels[..., 0].clamp(0, W - 1), pixels[..., 1].clamp(0, H - 1)
    index = (v.long() * W + u.long()).flatten(1)
    values = image.values.gather(1, index[..., None].expand(-1, -1, 4)).unflatten(
        1, inside.shape[1:]
    )
    color, z = values[..., :3], values[..., 3:]
    ray = rays(torch.stack([u, v], dim=-1).flatten(1, 2), K).unflatten(1, inside.shape[1:])
    R = rotation_of(poses)
    origin = -middle[..., None, :]
    along = (ray * middle[..., None, :]).sum(-1, keepdim=True) / (ray * ray).sum(-1, keepdim=True)
    known = z > 0
    position = (ray * torch.where(known, z, along) + origin) @ R
    context = None if image.context is None else ask(image.context, u, v, position / radius)
    return Points(position, color, F.normalize(ray, dim=-1) @ R, known[..., 0], inside, context)


def protocol(x: Tensor) -> Tensor:
    """Contract vectors (*, 3) beyond length 2 into the ball of radius 3, as in mip-NeRF 360 (eq.
    10).
    """
    far = x.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    return x / far * torch.where(far > 2, 3 - 2 / far, far)


class PoseLikelihood(nn.Module):
    """log p(image | pose) at a noise level, up to a constant an image: `scale` x the mean judgement
    of its points.

    width, blocks: of the residual MLP; octaves: of the position's Fourier features; sigma: the
    range of noise levels [m]; context: features of the proposal network that a point is judged by,
    with what it says there; None: by itself alone.
    """

    provides: ClassVar[Capabilities] = ("judge_points",)

    def __init__(
        self,
        width: int = 96,
        blocks: int = 3,
        octaves: int = 5,
        scale: float = 20.0,
        sigma: tuple[float, float] = (0.003, 0.25),
        context: int | None = None,
    ) -> None:
        super().__init__()
        self.context = context
        self.octaves, self.scale, self.sigma = octaves, scale, (float(sigma[0]), float(sigma[1]))
        surroundings = 0 if context is None else 9 + context
        self.enter = Linear(3 * (2 * octaves + 1) + 7 + surroundings, width)
        self.modulate = nn.Sequential(nn.Linear(9, width), nn.ReLU(), nn.Linear(width, 2 * width))
        self.blocks = nn.ModuleList([ResnetFC(width) for _ in range(blocks)])
        self.leave = nn.Linear(width, 1)
        self.outside = nn.Sequential(nn.Linear(9, 16), nn.ReLU(), nn.Linear(16, 1))

    def level(self, sigma: Tensor) -> Tensor:
        """Describe noise levels to the network.

        (*) [m] -> (*, 9), from -1 at the sharpest to 1 at the broadest.
        """
        low, high = math.log(self.sigma[0]), math.log(self.sigma[1])
        at = (2 * (sigma.clamp_min(1e-6).log() - low) / (high - low) - 1)[..., None]
        return torch.cat([at, fourier(at / 4, 4)[..., 1:]], dim=-1)

    def surroundings(self, points: Points, radius: float) -> Tensor:
        """Compare what the hypothesis makes of points with what the proposal network says of them.
        -> (B, N, P, 9 + C).
        """
        if points.context is None:
            raise UserError(
                "model/likelihood=contextual reads the proposal network; choose model/proposals=dense or "
                "model/likelihood=contrastive"
            )
        log_share, predicted, logit, features = points.context.split(
            [1, 3, 1, points.context.shape[-1] - 5], dim=-1
        )
        error = predicted - points.position / radius
        known = [log_share / 5, torch.sigmoid(logit), logit / 8]
        return torch.cat([*known, protocol(error), torch.asinh(10 * error), features], dim=-1)

    def judge(self, points: Points, level: Tensor, radius: float) -> Tensor:
        """Judge points one by one.  Points (B, N, P), level (B, 9) -> (B, N, P)."""
        p = protocol(points.position / radius)
        known = points.known[..., None].to(p.dtype)
        seen = [fourier(p / 2, self.octaves), points.color * 2 - 1, points.ray, known]
        if self.context is not None:
            seen.append(self.surroundings(points, radius))
        x = self.enter(torch.cat(seen, dim=-1))
        gain, bias = self.modulate(level)[:, None, None].chunk(2, dim=-1)
        x = torch.addcmul(x + bias, x, gain)
        for block in self.blocks:
            x = block(x)
        return self.leave(torch.relu(x))[..., 0]

    def judge_points(self, points: Points, sigma: float, center: Tensor, radius: float) -> Tensor:
        """Judge points one by one at one noise level [m].  Points (B, N, P) -> (B, N, P)."""
        return self.judge(points, self.level(points.position.new_tensor([sigma])), radius)

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
        """Score poses at noise levels.  poses (B, N, 4, 4), sigma (B,) or () [m] -> (B, N)."""
        B = poses.shape[0]
        noise = torch.randn(B, 1, pixels, 2, generator=generator, device=poses.device)
        # half a millimeter is lost on a pose in half precision
        with torch.autocast(poses.device.type, enabled=False):
            points = look(image, poses, center, radius, noise)
        level = self.level(sigma.expand(B))
        judged = torch.where(
            points.inside, self.judge(points, level, radius), self.outside(level)[:, None]
        )
        # [m]: nothing is seen closer than that
        too_near = torch.relu(0.15 - origin_of(poses, center)[..., 2])
        return self.scale * judged.mean(-1) - 200 * too_near
