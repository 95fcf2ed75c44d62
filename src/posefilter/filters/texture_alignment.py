"""Alignment of the estimate with the image's colors and the measured depth at once."""

from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Generator, Tensor

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.filters.icp import PointToPlaneIcp
from posefilter.filters.refine import object_of
from posefilter.filters.texture import (
    DARK,
    Print,
    blur_around,
    choose_blur,
    look_at_print,
    measure_texture,
    read_print,
    remove_linear,
)
from posefilter.geometry.lookup import sample
from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Encoding, Method
from posefilter.types import BeliefBatch, ObjectModel

_FEW = 30  # textured points: fewer say nothing
_RIM = 2.0  # [px] of the frame, where a blurred image is not known
_HALF = 0.5  # [px] on either side, between which the image's slope is taken
_MOVES = 6.0  # [px] that a point may be moved by
_PIXELS = 2.0  # that a point needs for itself
_REWEIGHTED = 3  # times that the weights of points are adapted to the residuals
_SIDES = 6  # of an object
_OUTLIER = 2.0  # standard deviations of a residual that halve a point's weight
_LEAST_NOISE = 0.01  # of the logarithm of colors


class Term(NamedTuple):
    """A term of the normal equations of one pose's twist."""

    information: Tensor  # (6, 6) float64
    slope: Tensor  # (6,) float64


class TextureAlignment:
    """Move the estimate so that its texture lies on the image's, and its surface on the depth.

    Direct image alignment (Lucas and Kanade 1981): with y the logarithm of the image's colors at
    the surface points that are seen, and x that of the object's own, Gauss-Newton steps over the
    pose minimize y - shading - gain x, where the shading is linear in the normal and gain and
    shading are fitted anew in each step. Points that do not fit lose their weight (Cauchy's loss).
    The image is blurred less from step to step. Added are the terms of point-to-plane ICP, and the
    estimate before as a Gaussian prior.

    Scans have their texture a millimeter or two beside their shape, and otherwise on each side: the
    texture of each of six sides may be shifted, with a Gaussian prior. The estimate is moved only
    where the texture then explains the image clearly better; without texture it stays.
    Color and depth should be registered: where they are not, the result follows the colors.

    Args:
        iterations: Gauss-Newton steps.
        initial_blur: Blur of an estimate before the first step, in units of the last step's; each
            step's is smaller by the same factor.
        prior: Standard deviation of the estimate before [m on the object's surface].
        independent: Share of the textured points that count as independent.
        min_correlation: Of the object's colors with the image's; below, they are not used.
        texture_error: Standard deviation of the shift of a side's texture [m].
        min_gain: By which the evidence of the texture must rise for the estimate to be moved [nat],
            see `measure_texture`.
        gate: Distance along the measured normal beyond which a measured point is not the surface
            point's [m]; in all, it may be 2.5 times as far away.
        noise: Standard deviation of a measured distance along the normal [m].
        effective: Surface points count as this many independent ones at most.
        points: Surface points at most, for the depth.

    Raises:
        UserError: A number is out of range.
    """

    requires: ClassVar[Capabilities] = ("color", "depth", "pose")

    def __init__(
        self,
        iterations: int = 5,
        initial_blur: float = 2.0,
        prior: float = 0.008,
        independent: float = 0.3,
        min_correlation: float = 0.5,
        texture_error: float = 0.002,
        min_gain: float = 20.0,
        gate: float = 0.006,
        noise: float = 0.004,
        effective: float = 240.0,
        points: int = 500,
    ) -> None:
        least = min(prior, independent, texture_error)
        if not (min(iterations, initial_blur) >= 1 and least > 0 and min_gain >= 0):
            raise UserError(
                "refine: alignment of the texture needs iterations and initial_blur of 1 or more, "
                "min_gain of 0 or more, prior, independent and texture_error above 0; got "
                f"{iterations}, {initial_blur}, {min_gain}, {prior}, {independent} and "
                f"{texture_error}"
            )
        if not 0 < min_correlation < 1:
            raise UserError(f"refine: min_correlation={min_correlation}: must lie between 0 and 1")
        self.depth = PointToPlaneIcp(
            initial_gate=gate, final_gate=gate, noise=noise, effective=effective, points=points
        )
        self.iterations, self.initial_blur, self.prior = iterations, initial_blur, prior
        self.texture_error, self.min_gain = texture_error, min_gain
        self.independent, self.min_correlation, self.gate = independent, min_correlation, gate

    @torch.no_grad()
    def __call__(
        self, belief: BeliefBatch, encoding: Encoding, method: Method, generator: Generator
    ) -> BeliefBatch:
        """Return the belief with the estimate moved; the score stays.

        Raises:
            UserError: The object has no texture.
        """
        object_model = object_of(method)
        first = belief.best
        texture = read_print(object_model, first)
        space = PoseSpace(tuple(object_model.center.tolist()), object_model.radius)
        precision = space.noise_scale(first.new_tensor(self.prior)).double().pow(-2).diag()
        surface = self.depth.choose_points(object_model.points).to(first)
        sides = find_sides(texture.normals)
        images = (encoding.measured_color, encoding.measured_depth, encoding.intrinsics)
        pose, compared = first, torch.zeros(len(first), dtype=torch.bool, device=first.device)
        moved = first.new_zeros(len(first), 6, dtype=torch.float64)
        for index in range(self.iterations):
            blur = self.initial_blur ** (1 - (index + 1) / self.iterations)
            information, slope, _ = self.depth.measure(
                pose, surface, object_model.center.to(first), encoding, self.gate
            )
            for row, image in enumerate(zip(*images, strict=True)):
                term = self._compare(pose[row], *image, texture, sides, object_model, blur)
                compared[row] = term is not None
                if term is not None:
                    information[row] += term.information
                    slope[row] += term.slope
            step = torch.linalg.solve(information + precision, slope - moved @ precision)
            pose, moved = space.move(pose, step.to(pose)), moved + step
        poses = torch.stack([first, pose], dim=1)
        fits = measure_texture(poses, encoding, object_model, shift=0)
        better = compared & (fits[:, 1] - fits[:, 0] > self.min_gain)
        return belief._replace(best=torch.where(better[:, None, None], pose, first))

    def _compare(
        self,
        pose: Tensor,
        color: Tensor,
        depth: Tensor,
        K: Tensor,
        texture: Print,
        sides: Tensor,
        object_model: ObjectModel,
        blur: float,
    ) -> Term | None:
        """Return what the colors say of a pose's twist; None where they say nothing.

        Args:
            pose: (4, 4) camera_from_object [m].
            color: (3, H, W) of the image.
            depth: (H, W) of the image [m].
            K: (3, 3) of its camera [px].
            texture: The object's textured points.
            sides: (P,) which side each is on.
            object_model: The object.
            blur: Of the image, in units of what suits the textured points' distance.
        """
        focal = float(K[0, 0])
        view = look_at_print(pose[None], depth, K, texture, object_model)
        size = view.pixels.new_tensor(color.shape[:0:-1])  # width, height
        inside = (view.pixels > _RIM) & (view.pixels < size - 1 - _RIM)
        seen = (view.seen & inside.all(-1))[0]
        if int(seen.sum()) < _FEW:
            return None
        points, normals, cosine, pixels = (part[0, seen] for part in view[:4])
        center = origin_of(pose[None], object_model.center.to(pose))[0]
        sigma = blur * choose_blur(texture, focal, float(center[2]))
        y, along = _look_up(color, pixels, sigma)
        basis = torch.cat([torch.ones_like(cosine)[:, None], normals], dim=-1)
        x, y, weights, gain = _fit(texture.color[seen], y, basis, cosine)
        power = weights[:, None] * x
        correlation = (power * y).sum() / ((power * x).sum() * _square(y, weights)).sqrt()
        if not float(correlation) > self.min_correlation:
            return None
        by_twist = pixel_derivatives(points, points - center, pose, K)
        by_shift = _shift_sides(by_twist, sides[seen], pose)
        slopes = along @ torch.cat([by_twist, by_shift], dim=-1)
        rows = remove_linear(slopes.flatten(1)[None], basis[None], weights[None])[0]
        rows = rows.unflatten(1, (3, -1)).double()
        # what the gain explains as well says nothing of the pose
        share = (power[..., None].double() * rows).sum((0, 1)) / (power * x).sum().double()
        rows = rows - x[..., None].double() * share
        residual = (y - gain * x).double()
        variance = _square(residual, weights) / (3 * weights.double().sum())
        covered = float((weights * (texture.spacing * focal / points[:, 2]).square()).sum())
        count = min(len(x), covered / (_PIXELS * max(1.0, sigma**2)))
        scale = self.independent * count / len(x) / variance.clamp_min(_LEAST_NOISE**2)
        weighted = rows * weights[:, None, None].double()
        information = scale * torch.einsum("ncd,nce->de", weighted, rows)
        slope = -scale * torch.einsum("ncd,nc->d", weighted, residual)
        # the shifts of the sides are eliminated
        prior = torch.eye(3 * _SIDES, dtype=rows.dtype, device=rows.device) / self.texture_error**2
        cross = information[6:, :6]
        explained = torch.linalg.solve(information[6:, 6:] + prior, cross).mT
        return Term(information[:6, :6] - explained @ cross, slope[:6] - explained @ slope[6:])


def find_sides(normals: Tensor) -> Tensor:
    """Return which of six sides of an object a point is on, by its normal: those of the axes that
    the normals gather about.  (P, 3) -> (P,).
    """
    axes = torch.linalg.eigh(normals.mT @ normals).eigenvectors
    along = normals @ axes
    return torch.cat([along, -along], dim=1).argmax(1)


def _fit(
    color: Tensor, observed: Tensor, basis: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the colors of object and image without shading, the points' robust weights, and the
    gain between them.

    (n, 3), (n, 3), (n, 4), (n,) -> (n, 3), (n, 3), (n,), ().
    """
    plain = weights
    for last in reversed(range(_REWEIGHTED)):
        colors = torch.cat([color, observed], dim=1)
        x, y = remove_linear(colors[None], basis[None], weights[None])[0].chunk(2, dim=1)
        power = weights[:, None] * x
        gain = (power * y).sum() / (power * x).sum().clamp_min(1e-12)
        if not last:
            break
        residual = y - gain * x
        spread = (1.4826 * residual.abs().median()).clamp_min(_LEAST_NOISE)
        weights = plain / (1 + residual.square().mean(1) / (_OUTLIER * spread).square())
    return x, y, weights, gain


def _shift_sides(by_twist: Tensor, sides: Tensor, pose: Tensor) -> Tensor:
    """Return how pixels move with shifts of each side's texture, in the object's axes.

    (n, 2, 6), (n,), (4, 4) -> (n, 2, 3 sides) [px/m].
    """
    by_shift = by_twist[..., :3] @ rotation_of(pose)
    on_side = F.one_hot(sides, _SIDES).to(pose)
    return (on_side[:, None, :, None] * by_shift[:, :, None]).flatten(2)


def _square(values: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted sum of squares.  (n, 3), (n,) -> ()."""
    return (weights[:, None] * values.square()).sum()


def _look_up(color: Tensor, pixels: Tensor, sigma: float) -> tuple[Tensor, Tensor]:
    """Return the logarithm of blurred colors at pixels, and its slopes.

    Args:
        color: (3, H, W).
        pixels: (n, 2) [px].
        sigma: Of the blur [px].

    Returns:
        (n, 3), and its derivatives by u and v, (n, 3, 2) [1/px].
    """
    image, corner = blur_around(color, pixels, sigma, _MOVES)
    steps = pixels.new_tensor([[0, 0], [-_HALF, 0], [_HALF, 0], [0, -_HALF], [0, _HALF]])
    at = (pixels - corner)[None] + steps[:, None]
    values = sample((image + DARK).log()[None], at.flatten(0, 1)[None])[0].unflatten(0, (5, -1))
    middle, left, right, above, below = values
    return middle, torch.stack([right - left, below - above], dim=-1) / (2 * _HALF)


def pixel_derivatives(points: Tensor, arms: Tensor, pose: Tensor, K: Tensor) -> Tensor:
    """Return how pixels move with the pose's twist (`PoseSpace.move`).

    Args:
        points: (n, 3) [m] in the camera's frame.
        arms: (n, 3) [m] from the object's center.
        pose: (4, 4).
        K: (3, 3).

    Returns:
        (n, 2, 6) [px/m] and [px/rad].
    """
    x, y, z = points.unbind(-1)
    zero = torch.zeros_like(z)
    du = torch.stack([K[0, 0] / z, zero, -K[0, 0] * x / z.square()], dim=-1)
    dv = torch.stack([zero, K[1, 1] / z, -K[1, 1] * y / z.square()], dim=-1)
    by_point = torch.stack([du, dv], dim=1)  # (n, 2, 3)
    # a turn w about the object's axes moves a point by R w x arm
    by_turn = torch.linalg.cross(arms[:, None].expand_as(by_point), by_point) @ rotation_of(pose)
    return torch.cat([by_point, by_turn], dim=-1)
