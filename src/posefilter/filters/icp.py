"""Refinement by the measured depth: the iterative closest point method, with a prior."""

from dataclasses import asdict, dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Generator, Tensor

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.filters.refine import object_of
from posefilter.geometry.camera import back_project, project
from posefilter.geometry.lookup import gather_pixels, nearest_pixel
from posefilter.geometry.pose import origin_of, rotation_of, transform
from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Encoding, HasDepth, Method
from posefilter.types import BeliefBatch

_FEW = 10.0  # surface points, by their weights: fewer say nothing
_GRAZING = 0.3  # cosine of the angle between a measured surface and the way to the camera
_FAR = 2.5  # widths of the loss, beyond which a measured point is not the surface point's
_NEAREST = 0.05  # [m] from the camera's plane
_STEP = 0.004  # [focal lengths] from a pixel to the neighbors that its normal is taken from
_BEND = (0.006, 0.01)  # [m, share of depth] between a pixel and its neighbors' mean: an edge


class Surface(NamedTuple):
    """What is measured at pixels."""

    points: Tensor  # (B, P, 3) [m]
    normals: Tensor  # (B, P, 3) unit, towards the camera
    known: Tensor  # (B, P) bool: there is depth, and no edge of it


@dataclass(eq=False)
class PointToPlaneIcp:
    """Lay the estimate's surface on the measured depth: point-to-plane ICP (Chen and Medioni 1992).

    Each surface point that faces the camera is paired with what is measured at its pixel
    (projective data association, Blais and Levine 1995), where that is near. Gauss-Newton steps
    minimize the distances along the measured normals under Tukey's robust loss, whose width falls.
    Depth does not determine every pose: a plane may slide along itself. The estimate before is
    therefore a Gaussian prior, and the result the most probable pose given both.

    Args:
        iterations: Gauss-Newton steps.
        initial_gate: Distance along the measured normal beyond which a pair does not count in the
            first step [m]; in all, its points may be 2.5 times as far apart.
        final_gate: In the last step; geometric between.
        prior: Standard deviation of the estimate before [m on the object's surface].
        noise: Standard deviation of a distance along the normal [m].
        effective: Points count as this many independent ones at most, since errors of depth are
            alike at neighboring pixels, and as errors of the mesh are.
        points: Surface points at most.

    Raises:
        UserError: A number is out of range.
    """

    requires: ClassVar[Capabilities] = ("depth", "pose")

    iterations: int = 5
    initial_gate: float = 0.015
    final_gate: float = 0.006
    prior: float = 0.004
    noise: float = 0.004
    effective: float = 120.0
    points: int = 500

    def __post_init__(self) -> None:
        given = asdict(self)
        if not min(given.values()) > 0 or self.final_gate > self.initial_gate:
            raise UserError(
                "refine: ICP needs numbers above 0, final_gate no larger than initial_gate; got "
                f"{', '.join(f'{name}={value}' for name, value in given.items())}"
            )

    @torch.no_grad()
    def __call__(
        self, belief: BeliefBatch, encoding: Encoding, method: Method, generator: Generator
    ) -> BeliefBatch:
        """Return the belief with the estimate moved; the score stays."""
        object_model = object_of(method)
        first = belief.best
        space = PoseSpace(tuple(object_model.center.tolist()), object_model.radius)
        center = object_model.center.to(first)
        surface = self.choose_points(object_model.points).to(first)
        precision = space.noise_scale(first.new_tensor(self.prior)).double().pow(-2).diag()
        pose, paired = first, torch.zeros(len(first), dtype=torch.bool, device=first.device)
        moved = first.new_zeros(len(first), 6, 1, dtype=torch.float64)
        for index in range(self.iterations):
            part = index / max(self.iterations - 1, 1)
            width = self.initial_gate * (self.final_gate / self.initial_gate) ** part
            information, slope, paired = self.measure(pose, surface, center, encoding, width)
            slope = slope[..., None] - precision @ moved
            step = torch.linalg.solve(information + precision, slope) * paired[:, None, None]
            # for turns as small as these, twists add up
            pose, moved = space.move(pose, step[..., 0].to(pose)), moved + step
        # without enough points in the last step what was paired before was something else
        return belief._replace(best=torch.where(paired[:, None, None], pose, first))

    def choose_points(self, points: Tensor) -> Tensor:
        """Return every so many of an object's surface points.  (P, 3) -> (`points` at most, 3)."""
        return points[:: -(-len(points) // self.points)]

    def measure(
        self, pose: Tensor, surface: Tensor, center: Tensor, encoding: HasDepth, width: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return what the depth says of a pose's twist.

        Args:
            pose: (B, 4, 4) camera_from_object [m].
            surface: (P, 3) points of the object [m].
            center: (3,) the object's center [m].
            encoding: Depth and camera.
            width: Of the loss [m].

        Returns:
            The normal equations of a Gauss-Newton step: matrices (B, 6, 6) and right sides (B, 6),
            in float64; and whether enough points were paired, (B,).
        """
        rows, offsets, weights = self._pair(pose, surface, center, encoding, width)
        total = weights.sum(-1)
        share = (self.effective / total.clamp_min(_FEW)).clamp_max(1) / self.noise**2
        weighted = rows.mT * (weights * share[:, None])[:, None]
        return weighted @ rows, (weighted @ offsets[..., None])[..., 0], total > _FEW

    def _pair(
        self, pose: Tensor, surface: Tensor, center: Tensor, encoding: HasDepth, width: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Pair surface points with what is measured at their pixels; arguments as of `measure`.

        Returns:
            Derivatives (B, P, 6) of each point's place along the measured normal by the twist, how
            far it has to go (B, P) [m], and its weight (B, P); in float64.
        """
        points, middle = transform(pose, surface), origin_of(pose, center)[:, None]
        ahead = points[..., 2] > _NEAREST
        pixels = nearest_pixel(project(points, encoding.intrinsics))
        measured = look_up(encoding.measured_depth, encoding.intrinsics, pixels)
        view = torch.nn.functional.normalize(points, dim=-1)
        facing = ((points - middle) * view).sum(-1) < 0
        frontal = (measured.normals * view).sum(-1) < -_GRAZING
        offset = measured.points - points
        near = offset.norm(dim=-1) < _FAR * width
        along = (offset * measured.normals).sum(-1)
        tukey = (1 - (along / width).square()).clamp_min(0).square()
        counted = measured.known & ahead & facing & frontal & near
        turn = torch.linalg.cross(points - middle, measured.normals) @ rotation_of(pose)
        rows = torch.cat([measured.normals, turn], dim=-1)
        return rows.double(), along.double(), (tukey * counted).double()


def look_up(depth: Tensor, K: Tensor, pixels: Tensor) -> Surface:
    """Return the measured points and normals at pixels.

    A normal is that of the differences between a pixel's neighbors on either side; there is none at
    an edge of depth, beside missing depth, or at the image's rim.

    Args:
        depth: (B, H, W) z-depth [m]; 0 unknown.
        K: (B, 3, 3) [px].
        pixels: (B, P, 2) int64 as (u, v); may lie outside.

    Returns:
        The surface (B, P).
    """
    step = (_STEP * K[:, 0, 0]).round().clamp_min(1).to(pixels)[:, None, None]
    sides = pixels.new_tensor([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]]) * step  # of each image
    around = pixels[:, :, None] + sides[:, None]
    z = gather_pixels(depth[:, None], around.flatten(1, 2)).view(around.shape[:-1])
    at = back_project(around.flatten(1, 2).to(z), z.flatten(1), K).view(*z.shape, 3)
    middle, right, left, below, above = at.unbind(2)
    normal = torch.linalg.cross(below - above, right - left)
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    normal = torch.where((normal * middle).sum(-1, keepdim=True) > 0, -normal, normal)
    bend = torch.stack([z[..., 1] + z[..., 2], z[..., 3] + z[..., 4]]) / 2 - z[..., 0]
    flat = (bend.abs() < (_BEND[0] + _BEND[1] * z[..., 0]) / 2).all(0)
    return Surface(middle, normal, (z > 0).all(-1) & flat)
