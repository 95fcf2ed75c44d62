"""By how much an estimate fits the image better than any other rotation that its shape allows.

The measured depth of a can looks the same at every rotation about its axis, and that of a box at
several. There texture and learned likelihood decide (`TextureRotations`), and how clearly they
decide says how likely the rotation is right.
"""

from collections.abc import Callable, MutableMapping
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from posefilter.filters.texture import (
    coarsen_texture,
    list_rotations,
    measure_texture,
    rotation_angles,
)
from posefilter.geometry.pose import transform
from posefilter.geometry.pose_error import subsample
from posefilter.protocols import HasColor
from posefilter.types import ObjectModel

_FAR = 0.1  # [diameters] by which a rotation moves the surface, from which on a pose is wrong
_POINTS = 200  # of the surface, which are moved
_FEW = 12  # rotations that are all compared with shifts of the image
_BEST = 4  # others are, of more: the best, each with
_BESIDE = 5  # those nearest to it, itself among them


class Rivals(NamedTuple):
    """The rotations that a shape allows and that would make a right pose wrong."""

    turns: Tensor  # (R, 4, 4) object_from_object
    # indices of some of them, no two of which are nearer than ten degrees
    first: Tensor
    beside: Tensor  # (R, _BESIDE) indices of those nearest to each, itself first; fewer if R is
    symmetries: Tensor  # of the object, under which a pose stays right


# of objects' shapes, as long as those are there
_KNOWN: MutableMapping[Tensor, Rivals] = WeakIdKeyDictionary()


def list_rivals(object_model: ObjectModel) -> Rivals | None:
    """Return the rivals of a right pose of a textured object; None where there are none."""
    shape = object_model.shape_symmetries
    if shape is None:  # a checkpoint of an earlier version
        return None
    known = _KNOWN.get(shape)
    if known is None or known.symmetries is not object_model.symmetries:
        known = _KNOWN[shape] = _list_rivals(object_model)
    return known if len(known.turns) else None


def _list_rivals(object_model: ObjectModel) -> Rivals:
    turns, first = list_rotations(object_model)
    points = subsample(object_model.points, _POINTS).to(turns)
    moved = transform(turns, points.expand(len(turns), -1, -1))
    same = transform(object_model.symmetries.to(turns), points[None])
    apart = torch.stack([(moved - one).norm(dim=-1).mean(-1) for one in same]).amin(0)
    far = apart > _FAR * object_model.diameter
    turns, number = turns[far], far.cumsum(0) - 1
    most = min(_BESIDE, len(turns))
    beside = rotation_angles(turns, turns).topk(most, dim=1, largest=False).indices
    return Rivals(turns, number[first[far[first]]], beside, object_model.symmetries)


def measure_rotation_margin(
    best: Tensor,
    image: HasColor,
    object_model: ObjectModel,
    evidence: Tensor,
    score: Callable[[Tensor], Tensor] | None = None,
) -> Tensor | None:
    """Return how far the log-posterior at estimates is above that at other rotations.

    It is the evidence of the texture, plus the learned log-likelihood where there is one. On
    photographs the texture alone decides less clearly than on renders.

    Args:
        best: (B, 4, 4) camera_from_object [m].
        image: B images with color and depth.
        object_model: The object, with a texture.
        evidence: (B,) of the texture at the estimates (`measure_texture`) [nat].
        score: Returns the learned log-likelihoods (B, N) of poses (B, N, 4, 4), if there is one.

    Returns:
        (B,) with m the difference to the best of the other rotations [nat], the logarithm of
        1 + |m| with the sign of m; None where the shape allows no other.
    """
    rivals = list_rivals(object_model)
    if rivals is None:
        return None
    turns, first = rivals.turns.to(best), rivals.first.to(best.device)
    near, coarse = first.expand(len(best), -1), coarsen_texture(object_model)
    score = score or _score_alike
    if len(first) > _FEW:
        poses = best[:, None] @ turns[first]
        rough = measure_texture(poses, image, coarse, shift=0) + score(poses)
        top = near.gather(1, rough.topk(_BEST, dim=1).indices)
        near = rivals.beside.to(best.device)[top].flatten(1)
    poses = best[:, None] @ turns[near]
    learned = score(torch.cat([best[:, None], poses], dim=1))
    other = (measure_texture(poses, image, coarse) + learned[:, 1:]).amax(1)
    margin = evidence + learned[:, 0] - other
    return margin.sign() * margin.abs().log1p()


def _score_alike(poses: Tensor) -> Tensor:
    return torch.zeros_like(poses[..., 0, 0])
