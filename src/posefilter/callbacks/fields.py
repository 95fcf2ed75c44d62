"""Ask a method what it makes of places that no particle need have visited: the likelihood field
(the paper, figure 5).

Two views of one field. Of poses: the score of the truth, shifted and turned. Of points: what one
point of the image would be worth, were it elsewhere in the object's frame.
"""

import math
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from posefilter.figures.field import PLANES, PointField, PoseField
from posefilter.figures.maps import Proposals
from posefilter.figures.particles import choose_steps, project_axes
from posefilter.geometry.camera import back_project, pixel_grid, project
from posefilter.geometry.pose import (
    invert,
    make_pose,
    origin_of,
    pose_about,
    rotation_of,
    transform,
)
from posefilter.geometry.rotation import exp_so3
from posefilter.nets.coordinates import HasCoordinates, query, true_coordinates
from posefilter.nets.layers import fast_bfloat16
from posefilter.nets.likelihood import Pixels, Points, sample_points
from posefilter.protocols import Encoding, ProposesPoses, ScoresPoses
from posefilter.types import Batch, ObjectModel, Step

_FINE = (2.0, 4.0, 8.0)  # [degrees] beside every fifteenth degree: sharp peaks are narrow
_LEVELS = 3  # of noise, at most
_PIXELS = 48  # image points of a pose
_CELLS = 31  # of a side of a slice of points
_DRAWN = 24  # poses of the proposal network


@runtime_checkable
class ScoresPoints(Protocol):
    """A likelihood that scores single image points."""

    def score_points(self, points: Points, sigma: float, center: Tensor, radius: float) -> Tensor:
        """Score points at a noise level [m].  Points (B, N, P) -> (B, N, P)."""
        ...


def choose_levels(steps: Sequence[Step]) -> tuple[float, ...]:
    """Return noise levels that a filter ran through, broad to sharp: the ends and what lies evenly
    between them.
    """
    found = sorted({float(step.sigma.reshape(-1)[0]) for step in steps}, reverse=True)
    return tuple(found[i] for i in choose_steps(len(found), _LEVELS))


def evaluate_pose_field(
    method: ScoresPoses,
    encoding: Encoding,
    truth: Tensor,
    object_model: ObjectModel,
    sigmas: Sequence[float],
    cells: int = 9,
) -> PoseField:
    """Score slices through the truth of one image, at each noise level, with the same image points
    at all of them.

    truth (4, 4) camera_from_object [m]; cells: a side of a slice, odd so that the truth is its
    middle. Slices go as far as six noise levels, at least a quarter of the object's radius and at
    most twice it.
    """
    center = object_model.center.to(truth)
    degrees = torch.tensor(
        sorted({0.0, *_FINE, *(-d for d in _FINE), *np.arange(-180.0, 181.0, 15.0).tolist()})
    )
    turned = turn_pose(truth, center, degrees.to(truth) * math.pi / 180).flatten(0, -3)
    radius = object_model.radius
    extents = tuple(min(max(6 * sigma, radius / 4), 2 * radius) for sigma in sigmas)
    planes, turns = [], []
    for sigma, extent in zip(sigmas, extents, strict=True):
        shifted = shift_pose(truth, extent, cells).flatten(0, -3)
        poses = torch.cat([truth[None], shifted, turned])[None]
        generator = torch.Generator(device=truth.device).manual_seed(0)
        # as the filter reads
        with torch.autocast(truth.device.type, torch.bfloat16, enabled=fast_bfloat16(truth.device)):
            found = method.score_poses(encoding, poses, sigma, generator, _PIXELS)
        score = found[0].float().cpu()
        less = (score - score[0])[1:].numpy()
        planes.append(less[: 3 * cells * cells].reshape(3, cells, cells))
        turns.append(less[3 * cells * cells :].reshape(3, len(degrees)))
    return PoseField(tuple(sigmas), extents, np.stack(planes), degrees.numpy(), np.stack(turns))


def shift_pose(pose: Tensor, extent: float, cells: int) -> Tensor:
    """Return a pose shifted within the planes of the object's axes.

    (4, 4) -> (3, cells, cells, 4, 4).
    """
    line = torch.linspace(-extent, extent, cells, dtype=pose.dtype, device=pose.device)
    shift = torch.zeros(3, cells, cells, 3, dtype=pose.dtype, device=pose.device)
    for k, (a, b) in enumerate(PLANES):
        shift[k, :, :, a], shift[k, :, :, b] = line[None, :], line[:, None]
    return pose @ make_pose(torch.eye(3, dtype=pose.dtype, device=pose.device), shift)


def turn_pose(pose: Tensor, center: Tensor, angles: Tensor) -> Tensor:
    """Return a pose turned about the object's axes through its center.

    (4, 4), (3,) [m], (A,) [rad] -> (3, A, 4, 4).
    """
    axes = torch.eye(3, dtype=pose.dtype, device=pose.device)
    rotation = rotation_of(pose) @ exp_so3(axes[:, None] * angles[None, :, None])
    return pose_about(rotation, rotation_of(pose) @ center + pose[:3, 3], center)


def evaluate_point_field(
    likelihood: ScoresPoints,
    image: Pixels,
    truth: Tensor,
    object_model: ObjectModel,
    pixel: tuple[int, int],
    on: bool,
    sigmas: Sequence[float],
    depthwise: bool = False,
) -> PointField:
    """Judge one pixel of one image at places in the object's frame, its color and ray as they are.

    The slice goes through where the pixel lies under the truth (4, 4), across the viewing ray, or
    (`depthwise`) along it: it is spanned by the two object axes that lie best so.
    """
    points = make_point(pixel, image, truth, object_model)
    place, center = points.position[0, 0, 0], object_model.center.to(points.position)
    order = points.ray[0, 0, 0].abs().argsort().tolist()  # the axis most along the ray comes last
    plane = (min(order[1:]), max(order[1:])) if depthwise else (min(order[:2]), max(order[:2]))
    extent = 1.3 * object_model.radius
    line = torch.linspace(-extent, extent, _CELLS, dtype=truth.dtype, device=truth.device)
    places = place.expand(_CELLS, _CELLS, 3).clone()
    places[..., plane[0]], places[..., plane[1]] = line[None, :], line[:, None]
    asked = torch.cat([place[None], places.flatten(0, 1)])
    alike = lambda x: x.expand(1, 1, len(asked), *x.shape[3:])  # noqa: E731
    many = Points(
        asked[None, None],
        *(alike(x) for x in (points.color, points.ray, points.known, points.inside)),
    )
    radius = object_model.radius
    if image.context is not None:  # what the proposal network says of the place that is asked for
        u, v = (torch.full((1, 1, len(asked)), float(x), device=truth.device) for x in pixel)
        many = many._replace(context=query(image.context, u, v, many.position / radius))
    judged = [likelihood.score_points(many, sigma, center, radius)[0, 0] for sigma in sigmas]
    found = torch.stack([one.float().cpu() for one in judged]).numpy()
    scores = found[:, 1:].reshape(len(sigmas), _CELLS, _CELLS)
    return PointField(
        pixel, on, place.cpu().numpy(), plane, extent, tuple(sigmas), scores, found[:, 0]
    )


def make_point(
    pixel: tuple[int, int], image: Pixels, truth: Tensor, object_model: ObjectModel
) -> Points:
    """Return one pixel (u, v) of one image as a point that the truth (4, 4) looks at.  -> Points
    (1, 1, 1).
    """
    center = object_model.center.to(truth)
    middle = origin_of(truth, center)
    extent = object_model.radius * image.intrinsics[0, 0, 0] / middle[2].clamp_min(0.1)
    # what `sample_points` will undo
    noise = (truth.new_tensor(pixel) - project(middle[None], image.intrinsics[0])[0]) / extent
    return sample_points(
        image, truth[None, None], center, object_model.radius, noise[None, None, None], spread=1.0
    )


def choose_pixels(batch: Batch, object_model: ObjectModel) -> list[tuple[tuple[int, int], bool]]:
    """Choose pixels of known depth in one image: one well on the object, and one off it but near;
    (u, v), and which it is.

    batch: of one image. Empty where the object is not seen.
    """
    mask, known = batch.mask[0, 0].cpu().numpy(), (batch.depth[0, 0] > 0).cpu().numpy()
    H, W = mask.shape
    if not (mask & known).any():
        return []
    within = distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1] * known
    best = [int(within.argmax())]
    grid = pixel_grid(H, W, device=batch.depth.device).reshape(1, -1, 2)
    points = back_project(grid, batch.depth.flatten(1), batch.intrinsics)
    local = transform(invert(batch.camera_from_object), points)[0] - object_model.center.to(points)
    away = np.abs(local.norm(dim=-1).cpu().numpy() - object_model.radius)
    off = (distance_transform_edt(~mask) > 4) & known
    if off.any():
        best.append(int(np.where(off.reshape(-1), away, np.inf).argmin()))
    return [((i % W, i // W), number == 0) for number, i in enumerate(best)]


def predict_proposals(
    method: ProposesPoses, encoding: HasCoordinates, batch: Batch, object_model: ObjectModel
) -> Proposals | None:
    """Return what the proposal network makes of one image; None where no depth is known."""
    if not bool(encoding.cells.valid.any()):
        return None
    center = object_model.center.to(batch.depth)
    generator = torch.Generator(device=batch.depth.device).manual_seed(0)
    poses = method.propose_poses(encoding, _DRAWN, generator)[0].cpu().double()
    middle, K = object_model.center.cpu().double(), batch.intrinsics[0].cpu().double()
    axes = project_axes(poses, middle, 0.5 * object_model.radius, K)
    truth, _, usable = true_coordinates(
        encoding.cells, batch.mask, batch.camera_from_object, center, object_model.radius
    )
    true, on = truth[0], usable[0]
    chance, coordinate = encoding.coordinates.logit[0].sigmoid(), encoding.coordinates.coordinate[0]
    off = (coordinate - true).norm(dim=-1)[on]
    error = object_model.radius * float(off.mean()) if len(off) else math.nan
    arrays = [x.detach().cpu().numpy() for x in (chance, coordinate, true, on)]
    return Proposals(arrays[0], arrays[1], arrays[2], arrays[3], axes, error)
