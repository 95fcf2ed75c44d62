"""The likelihood of a pose: a network scores single image points under the hypothesis, and their
mean is the log-likelihood.

For each pose, pixels are drawn around its projected center, lifted by their depth and mapped into
its object frame. A point's inputs are its position there, its color, the viewing ray in that frame
(which tells a surface behind the hypothesis from one in front of it) and the noise level. One
network thus represents a family of likelihoods, from broad to sharp.

A single pixel is ambiguous. A point may therefore have *context* too, from the coordinate network
at its pixel: membership of the object, the probability of the fragment that the hypothesis predicts
there, the position in it, and features that are trained by the likelihood's loss.
"""

import math
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Generator, Tensor, nn

from posefilter.capabilities import Capabilities
from posefilter.geometry.camera import project, rays
from posefilter.geometry.lookup import gather_rows
from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.nets.coordinates import Context, Coordinates, flatten_context, query
from posefilter.nets.fused import Tables, applies, missing_context, score, score_on_gpu
from posefilter.nets.layers import ResnetFC, fourier
from posefilter.nets.linear import Linear
from posefilter.nets.quasi_monte_carlo import draw_quasi_random
from posefilter.nets.surface_term import SurfaceTerm

SPREAD = 0.6  # of the pixels that a pose is scored by, in projected radii of the object


class Pixels(NamedTuple):
    """Images, flattened for gathering."""

    values: Tensor  # (B, H * W, 4) red, green, blue in [0, 1], z-depth [m] (0 unknown)
    size: tuple[int, int]  # H, W
    intrinsics: Tensor  # (B, 3, 3) [px]
    context: Context | None = None  # output of the coordinate network
    tables: Tables | None = None  # of the context, where poses are scored without gradient
    even: bool = False  # whether a pose's image points are drawn evenly instead of independently

    @property
    def camera(self) -> list[Tensor]:
        """Focal lengths fx, fy and principal point cx, cy, (B, 1, 1) each [px]."""
        entries = ((0, 0), (1, 1), (0, 2), (1, 2))
        return [self.intrinsics[:, row, column, None, None] for row, column in entries]


class Points(NamedTuple):
    """The image points of each pose, in that pose's object frame, relative to the object's
    center.
    """

    # (B, N, P, 3) [m]; where depth is unknown, the ray's point nearest to the center
    position: Tensor
    color: Tensor  # (B, N, P, 3) in [0, 1]
    ray: Tensor  # (B, N, P, 3) unit viewing ray
    known: Tensor  # (B, N, P) bool: depth is known
    inside: Tensor  # (B, N, P) bool: the pixel lies in the frame
    context: Tensor | None = None  # (B, N, P, 5 + C), as returned by `query`


class Region(NamedTuple):
    """A part of the object's surface, which image points are drawn about."""

    center: Tensor  # (3,) in the object's frame [m]
    radius: float  # [m]
    surface: Tensor  # (Q, 3) points of the part's surface [m], for `SurfaceTerm`


def flatten_images(
    rgb: Tensor, depth: Tensor, K: Tensor, coordinates: Coordinates | None = None
) -> Pixels:
    """Flatten images for gathering, with the coordinate network's output if points have context.

    (B, 3, H, W) in [0, 1], (B, 1, H, W) [m], (B, 3, 3) [px] -> Pixels.
    """
    H, W = rgb.shape[-2:]
    context = None if coordinates is None else flatten_context(coordinates, H, W)
    values = torch.cat([rgb, depth], dim=1).flatten(2).transpose(1, 2).contiguous()
    return Pixels(values, (H, W), K, context)


def sample_points(
    image: Pixels,
    poses: Tensor,
    center: Tensor,
    radius: float,
    noise: Tensor,
    spread: float = SPREAD,
    anchor: Tensor | None = None,
) -> Points:
    """Gather the pixels of each pose, and map them into its object frame.

    Pixels are the projected anchor + spread x projected radius x noise, rounded. With the same
    noise for all poses of an image their scores are comparable (common random numbers).

    Args:
        image: The images.
        poses: (B, N, 4, 4) camera_from_object [m].
        center: (3,) the object's center [m].
        radius: The object's radius [m].
        noise: (B, 1 or N, P, 2) standard normal.
        spread: Standard deviation of the pixels, in projected radii.
        anchor: (3,) the object point about which pixels are drawn [m]; None for the center.

    Returns:
        Points (B, N, P).
    """
    H, W = image.size
    K = image.intrinsics
    middle = origin_of(poses, center)
    about = middle if anchor is None else origin_of(poses, anchor)
    reach = spread * radius * K[:, None, 0, 0] / about[..., 2].clamp_min(0.1)
    pixels = (project(about, K)[..., None, :] + reach[..., None, None] * noise).round()
    inside = (
        (pixels[..., 0] >= 0) & (pixels[..., 0] < W) & (pixels[..., 1] >= 0) & (pixels[..., 1] < H)
    )
    u, v = pixels[..., 0].clamp(0, W - 1), pixels[..., 1].clamp(0, H - 1)
    index = (v.long() * W + u.long()).flatten(1)
    values = gather_rows(image.values, index).unflatten(1, inside.shape[1:])
    color, z = values[..., :3], values[..., 3:]
    ray = rays(torch.stack([u, v], dim=-1).flatten(1, 2), K).unflatten(1, inside.shape[1:])
    R = rotation_of(poses)
    origin = -middle[..., None, :]
    along = (ray * middle[..., None, :]).sum(-1, keepdim=True) / (ray * ray).sum(-1, keepdim=True)
    known = z > 0
    position = (ray * torch.where(known, z, along) + origin) @ R
    context = None if image.context is None else query(image.context, u, v, position / radius)
    return Points(position, color, F.normalize(ray, dim=-1) @ R, known[..., 0], inside, context)


def contract(x: Tensor) -> Tensor:
    """Contract vectors (*, 3) beyond length 2 into the ball of radius 3, as in mip-NeRF 360 (eq.
    10).
    """
    far = x.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    return x / far * torch.where(far > 2, 3 - 2 / far, far)


class PoseLikelihood(nn.Module):
    """log p(image | pose) at a noise level, up to a constant for each image.

    It is `scale` x the mean score of the pose's points.

    Args:
        width: Width of the residual MLP.
        blocks: Its number of residual blocks.
        octaves: Of the position's Fourier features.
        scale: Factor on the mean score.
        sigma: Lowest and highest noise level [m].
        context: Features of the coordinate network for each point; None for points without context.
        surface: A term from the hypothesis's surface, added to the mean score; None for none.
        ray: Whether the network is given the viewing ray (in an ablation it is 0).
    """

    provides: ClassVar[Capabilities] = ("common_points", "score_parts", "score_points")

    def __init__(
        self,
        width: int = 96,
        blocks: int = 3,
        octaves: int = 5,
        scale: float = 20.0,
        sigma: tuple[float, float] = (0.003, 0.25),
        context: int | None = None,
        surface: SurfaceTerm | None = None,
        ray: bool = True,
    ) -> None:
        super().__init__()
        self.context, self.surface, self.ray = context, surface, ray
        self.octaves, self.scale, self.sigma = octaves, scale, (float(sigma[0]), float(sigma[1]))
        surroundings = 0 if context is None else 9 + context
        self.enter = Linear(3 * (2 * octaves + 1) + 7 + surroundings, width)
        self.modulate = nn.Sequential(nn.Linear(9, width), nn.ReLU(), nn.Linear(width, 2 * width))
        self.blocks = nn.ModuleList([ResnetFC(width) for _ in range(blocks)])
        self.leave = nn.Linear(width, 1)
        self.outside = nn.Sequential(nn.Linear(9, 16), nn.ReLU(), nn.Linear(16, 1))

    def level(self, sigma: Tensor) -> Tensor:
        """Encode noise levels.  (*) [m] -> (*, 9); the first is -1 at the lowest and 1 at the
        highest.
        """
        low, high = math.log(self.sigma[0]), math.log(self.sigma[1])
        at = (2 * (sigma.clamp_min(1e-6).log() - low) / (high - low) - 1)[..., None]
        return torch.cat([at, fourier(at / 4, 4)[..., 1:]], dim=-1)

    def surroundings(self, points: Points, radius: float) -> Tensor:
        """Return context inputs: the hypothesis compared with the coordinate network's output.

        -> (B, N, P, 9 + C).

        Raises:
            UserError: The points have no context.
        """
        if points.context is None:
            raise missing_context()
        log_prob, predicted, logit, features = points.context.split(
            [1, 3, 1, points.context.shape[-1] - 5], dim=-1
        )
        error = predicted - points.position / radius
        known = [log_prob / 5, torch.sigmoid(logit), logit / 8]
        return torch.cat([*known, contract(error), torch.asinh(10 * error), features], dim=-1)

    def score_at_level(self, points: Points, level: Tensor, radius: float) -> Tensor:
        """Score points one by one.  Points (B, N, P), level (B, 9) -> (B, N, P)."""
        p = contract(points.position / radius)
        known = points.known[..., None].to(p.dtype)
        ray = points.ray if self.ray else torch.zeros_like(points.ray)
        inputs = [fourier(p / 2, self.octaves), points.color * 2 - 1, ray, known]
        if self.context is not None:
            inputs.append(self.surroundings(points, radius))
        x = self.enter(torch.cat(inputs, dim=-1))
        gain, bias = self.modulate(level)[:, None, None].chunk(2, dim=-1)
        x = torch.addcmul(x + bias, x, gain)
        for block in self.blocks:
            x = block(x)
        return self.leave(torch.relu(x))[..., 0]

    def score_points(self, points: Points, sigma: float, center: Tensor, radius: float) -> Tensor:
        """Score points one by one at one noise level [m].  Points (B, N, P) -> (B, N, P)."""
        return self.score_at_level(points, self.level(points.position.new_tensor([sigma])), radius)

    def forward(
        self,
        image: Pixels,
        poses: Tensor,
        sigma: Tensor,
        center: Tensor,
        radius: float,
        pixels: int,
        generator: Generator,
        region: Region | None = None,
    ) -> Tensor:
        """Score poses at noise levels.

        Args:
            image: The images.
            poses: (B, N, 4, 4) camera_from_object [m].
            sigma: (B,) or () noise level [m].
            center: (3,) the object's center [m].
            radius: The object's radius [m].
            pixels: Image points of each pose.
            generator: Source of randomness.
            region: The part of the object that is judged; None: the whole. Points are then drawn
                about the part, as wide in its radii as else in the object's, and the surface is
                the part's. What the network is given of a point stays the same.

        Returns:
            Log-likelihoods (B, N).
        """
        if image.even:
            noise = draw_quasi_random(len(poses), pixels, generator, poses.device)
        else:
            noise = torch.randn(len(poses), 1, pixels, 2, generator=generator, device=poses.device)
        if applies(poses.device) and sigma.numel() == 1 and region is None:
            kind = poses.device.type
            half = torch.is_autocast_enabled(kind)
            dtype = torch.get_autocast_dtype(kind) if half else poses.dtype
            with torch.autocast(kind, enabled=False):
                if kind == "cuda":
                    own = (image, poses, sigma, center, radius, noise, dtype)
                    return score_on_gpu(self, *own)
                found = score(self, image, poses, sigma, center, radius, noise, dtype)
                return found + self.judge_surface(image, poses, sigma, center, radius)
        # half precision would round poses to half a millimeter
        with torch.autocast(poses.device.type, enabled=False):
            spread, anchor = SPREAD, None
            if region is not None:
                spread, anchor = SPREAD * region.radius / radius, region.center
            points = sample_points(image, poses, center, radius, noise, spread, anchor)
            surface = self.judge_surface(image, poses, sigma, center, radius, region)
        return self.score_sampled(points, poses, sigma, center, radius) + surface

    def judge_surface(
        self,
        image: Pixels,
        poses: Tensor,
        sigma: Tensor,
        center: Tensor,
        radius: float,
        region: Region | None = None,
    ) -> Tensor | float:
        """Return the term of the hypotheses' surfaces, 0 without one; arguments as of `forward`.

        -> (B, N).
        """
        if self.surface is None:
            return 0.0
        at = self.level(sigma.expand(len(poses)))
        middle, points = (center, None) if region is None else (region.center, region.surface)
        term: Tensor = self.surface(image, poses, sigma, at, middle, radius, points)
        return term

    def score_sampled(
        self, points: Points, poses: Tensor, sigma: Tensor, center: Tensor, radius: float
    ) -> Tensor:
        """Score poses by points that are drawn already; arguments as of `forward`.  -> (B, N)."""
        level = self.level(sigma.expand(len(poses)))
        scores = self.score_at_level(points, level, radius)
        return self.pool(scores, points.inside, level, poses, center)

    def pool(
        self, scores: Tensor, inside: Tensor, level: Tensor, poses: Tensor, center: Tensor
    ) -> Tensor:
        """Return the poses' scores from those of their points.

        Args:
            scores: (B, N, P) of the points.
            inside: (B, N, P) bool, which of them lie in the frame.
            level: (B, 9) or (1, 9) encoded noise levels.
            poses: (B, N, 4, 4) camera_from_object [m].
            center: (3,) the object's center [m].

        Returns:
            Log-likelihoods (B, N).
        """
        scores = torch.where(inside, scores, self.outside(level)[:, None])
        # penalize centers closer than 0.15 m
        too_near = torch.relu(0.15 - origin_of(poses, center)[..., 2])
        return self.scale * scores.mean(-1) - 200 * too_near
