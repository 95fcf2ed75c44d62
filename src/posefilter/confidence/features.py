"""Features of an estimate: cheap numbers of a finished filter, of which more speaks for it.

A learned likelihood compares poses of one image; between images its level is arbitrary.  So they
ask what the likelihood does not: do the particles agree, does the measured depth show a
surface where the pose says, and does the proposal network, which has seen the image as a whole,
take the same pixels for the same points of the object?
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from posefilter.confidence.rotation_margin import measure_rotation_margin
from posefilter.filters.texture import coarsen_texture, measure_texture
from posefilter.geometry.camera import project
from posefilter.geometry.lookup import gather_pixels, nearest_pixel
from posefilter.geometry.pose import invert, transform
from posefilter.geometry.pose_error import subsample
from posefilter.geometry.spaces import PoseSpace
from posefilter.geometry.symmetries import densify, gather_copies
from posefilter.nets.coordinates import Cells, Coordinates
from posefilter.types import Batch, BeliefBatch, ObjectModel

_POINTS = 200  # of the surface: as many as exported weights carry
_NOISE = 0.005  # [m] of the depth
_FEW = 5  # points of the surface, so that little visible surface does not count as much texture
_CELLS = 6  # of the network, that a small object covers
_NEAREST = 0.01  # [m] points before the camera's plane


def measure_belief(belief: BeliefBatch, object_model: ObjectModel) -> dict[str, Tensor]:
    """Return how the particles agree with the estimate.

    Args:
        belief: B beliefs.
        object_model: The object.

    Returns:
        (B,) each. `score`: the estimate's log-likelihood. `concentration`: the negative logarithm
        of the particles' root mean square distance from the estimate (`PoseSpace`), in diameters.
        Particles at poses that a symmetry makes one agree; it is `concentration_up_to_symmetry`
        then, since calibrations of earlier versions know another number by the first name.
    """
    space = PoseSpace(tuple(object_model.center.tolist()), object_model.radius)
    weights, best, poses = belief.log_weights.exp(), belief.best, belief.poses
    name = "concentration"
    if len(object_model.symmetries) > 1:
        name = "concentration_up_to_symmetry"
        group = densify(object_model.symmetries.to(best))
        place = object_model.center.to(best), object_model.radius, group
        pairs = zip(poses, best, strict=True)
        poses = torch.stack([gather_copies(own, about, *place) for own, about in pairs])
    distance = space.distance(poses, best[:, None]) / object_model.diameter
    spread = (weights * distance.square()).sum(1).sqrt()
    return {"score": belief.score, name: -spread.clamp(1e-3, 1e3).log()}


def measure_depth(best: Tensor, batch: Batch, object_model: ObjectModel) -> dict[str, Tensor]:
    """Return whether the depth shows a surface where poses put the object's.

    A surface point whose pixel shows a surface at its own depth agrees; one before which something
    is measured is hidden, by the object itself or by another, and says nothing; one whose pixel
    shows what lies behind it is seen through, and speaks against the pose.

    Args:
        best: (B, 4, 4) camera_from_object [m].
        batch: B images.
        object_model: The object.

    Returns:
        (B,) each. `surface`: the share of the points that agree. `free_space`: of those that agree
        or are seen through, the share that agrees.
    """
    known, behind, tolerance = _compare_depth(best, batch, object_model)
    agrees = (known & (behind.abs() < tolerance)).float().mean(1)
    through = (known & (behind >= tolerance)).float().mean(1)
    few = 1 / known.shape[1]
    return {"surface": agrees, "free_space": (agrees + few) / (agrees + through + 2 * few)}


def measure_hidden(pose: Tensor, batch: Batch, object_model: ObjectModel) -> Tensor:
    """Return the share of an object's surface before which something nearer is measured.

    Of a visible object it is the part that faces away, of one that is covered 1. It is the share of
    the points in the frame with known depth; where these are less than half, of half.

    (B, 4, 4) camera_from_object [m] -> (B,).
    """
    known, behind, tolerance = _compare_depth(pose, batch, object_model)
    hidden = (known & (behind <= -tolerance)).sum(1)
    return hidden / known.sum(1).clamp_min(known.shape[1] / 2)


def _compare_depth(
    poses: Tensor, batch: Batch, object_model: ObjectModel
) -> tuple[Tensor, Tensor, float]:
    """Return of surface points (B, P) whether the depth at them is known, how far what is measured
    lies behind them [m], and by how much it may for the same surface [m].
    """
    points = transform(poses, subsample(object_model.points, _POINTS).to(poses))
    pixels = nearest_pixel(project(points, batch.intrinsics))
    depth = gather_pixels(batch.depth, pixels)[..., 0]  # 0 off the frame
    known = (depth > 0) & (points[..., 2] > _NEAREST)
    return known, depth - points[..., 2], _NOISE + 0.05 * object_model.diameter


class _Image(NamedTuple):
    """What a texture is compared with."""

    measured_color: Tensor
    measured_depth: Tensor
    intrinsics: Tensor


def measure_print(
    best: Tensor,
    batch: Batch,
    object_model: ObjectModel,
    surface: Tensor,
    margin: Tensor | None = None,
    score: Callable[[Tensor], Tensor] | None = None,
) -> dict[str, Tensor]:
    """Return whether the image shows the object's texture where poses put it.

    Args:
        best: (B, 4, 4) camera_from_object [m].
        batch: B images.
        object_model: The object.
        surface: (B,) as of `measure_depth`.
        margin: (B,) `rotation_margin` of earlier images, which is then not measured.
        score: Returns the learned log-likelihoods (B, N) of poses (B, N, 4, 4), if there is one.

    Returns:
        (B,) each; nothing where the object has no texture. `texture`: the logarithm of one plus the
        evidence of the texture [nat]. `texture_density`: the same less the logarithm of `surface`,
        since more of a surface that is seen should show more of its texture. `rotation_margin`: how
        far the estimate's log-posterior is above that of other rotations; absent where the shape
        allows none.
    """
    if object_model.texture is None:
        return {}
    image = _Image(batch.rgb, batch.depth[:, 0], batch.intrinsics)
    evidence = measure_texture(best[:, None], image, coarsen_texture(object_model))[:, 0]
    out = {"texture": evidence.log1p()}
    out["texture_density"] = out["texture"] - (surface + _FEW / _POINTS).log()
    if margin is None:
        margin = measure_rotation_margin(best, image, object_model, evidence, score)
    return out if margin is None else {**out, "rotation_margin": margin}


def measure_coordinates(
    best: Tensor, coordinates: Coordinates, cells: Cells, object_model: ObjectModel
) -> dict[str, Tensor]:
    """Return whether the network of dense object coordinates sees the object where poses put it.

    A cell is on the object where its measured point lies on the object's surface at the pose.

    Args:
        best: (B, 4, 4) camera_from_object [m].
        coordinates: The network's output.
        cells: The measured point of each cell.
        object_model: The object.

    Returns:
        (B,) each. `mask_precision`: of the cells that the network takes for the object, by its
        probability, the share that is on it. `mask_recall`: of the cells that are on the object,
        the share that the network takes for it. `coordinates`: of the cells that the network takes
        for the object, the share whose predicted object point is the one that the pose puts there,
        within a fifth of the radius. `top_objectness`: the mean probability of the cells that the
        network is surest of, wherever they are.
    """
    share = torch.sigmoid(coordinates.logit).flatten(1) * cells.valid.flatten(1)
    points = transform(invert(best), cells.point.flatten(1, 2))
    surface = subsample(object_model.points, _POINTS).to(best)
    nearest = torch.cdist(points, surface.expand(len(best), -1, -1)).amin(-1)
    on = (nearest < _NOISE + 0.08 * object_model.diameter) & cells.valid.flatten(1)
    predicted = coordinates.coordinate.flatten(1, 2)
    error = (predicted - (points - object_model.center.to(best)) / object_model.radius).norm(dim=-1)
    total, few = share.sum(1), 0.5  # cells, so that few of them tell little
    return {
        "mask_precision": (share * on).sum(1) / (total + few),
        "mask_recall": (share * on).sum(1) / (on.sum(1) + few),
        "coordinates": (share * (error < 0.2)).sum(1) / (total + few),
        "top_objectness": share.topk(min(_CELLS, share.shape[1]), dim=1).values.mean(1),
    }
