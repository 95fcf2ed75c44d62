"""How large the object appears in an image, relative to its mesh.

A wrong depth scale or focal length makes every measured distance wrong by a factor, and the best
pose of the wrong points scores well: neither the likelihood nor the particles tell. The network of
dense object coordinates does. It says which point of the object each cell shows, from how the
object looks; the depth says how far these cells are apart. The two are compared by a similarity
transform, whose scale is 1 where the inputs are right.
"""

import math
import weakref
from collections.abc import MutableMapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.nets.coordinates import Cells, Coordinates
from posefilter.types import ObjectModel

_LEAST, _MOST, _STEPS = 0.5, 2.0, 29  # of the scale, at equal ratios
_ROUNDS = 4  # of the fit at each scale
_NOISE = 0.08  # of predicted object points, in radii
_OUTLIER = -6.0  # log-likelihood of a cell, below which it is another thing's
_CELLS = 64  # at most, spread over the object
_FEWEST = 8  # cells, below which nothing is said
_TOLERANCE = math.log(1.12)  # of the scale, which the network's own errors reach
_LEAST_GAIN = 8.0  # of the gain: it counts cells as independent, which neighbors are not
_EXPLAINED = 0.5  # share, below which the network and the estimate do not tell of one object


class ScaleRatio(NamedTuple):
    """The scale of measured over known distances on the object, of each image."""

    scale: Tensor  # (B,) the most likely; nan where too few cells show the object
    gain: Tensor  # (B,) its log-likelihood, of all cells together, above that of scale 1; >= 0
    explained: Tensor  # (B,) the share of the cells that are then where the network puts them

    def contradicts(self) -> Tensor:
        """Return of which images the inputs cannot be right, (B,) bool."""
        off = self.scale.log().abs() > _TOLERANCE  # not of nan
        return off & (self.gain > _LEAST_GAIN) & (self.explained > _EXPLAINED)


# of estimates, as long as those are there: the output of the network and the cells that it was
# measured by, and the size, which is asked for when an answer is chosen and again for the result
_KNOWN: MutableMapping[Tensor, tuple[weakref.ref[Tensor], weakref.ref[Tensor], ScaleRatio]]
_KNOWN = WeakIdKeyDictionary()


def measure_scale_ratio(
    best: Tensor, coordinates: Coordinates, cells: Cells, object_model: ObjectModel
) -> ScaleRatio:
    """Measure how large the object appears, by the profile likelihood of the scale.

    At each scale s the object's points X lie at t + s R X. R is the estimate's. t, and which
    fragment of the object a cell shows, are fitted by expectation maximization from the estimate's
    center: the cell's log-likelihood is log sum_k share_k exp(-|p - t - s R X_k|^2 / 2 noise^2).

    Args:
        best: (B, 4, 4) camera_from_object [m], the estimates.
        coordinates: The network's output.
        cells: The measured point of each cell.
        object_model: The object.
    """
    known = _KNOWN.get(best)
    if known is not None and known[0]() is coordinates.logit and known[1]() is cells.valid:
        return known[2]
    found = [
        _measure(best[i], _seen(coordinates, cells, i), object_model) for i in range(len(best))
    ]
    size = ScaleRatio(*(torch.stack(part) for part in zip(*found, strict=True)))
    _KNOWN[best] = weakref.ref(coordinates.logit), weakref.ref(cells.valid), size
    return size


def pool_gains(ratios: Sequence[ScaleRatio], present: Sequence[Tensor]) -> list[ScaleRatio]:
    """Return the scale ratios of several objects in the same images, judged together.

    Depth and intrinsics are the same for all objects of an image. So the gain of each object's
    scale is its own and that of every other object that is there and has the same scale, up to the
    tolerance of one.

    Args:
        ratios: One an object, of B images each.
        present: (B,) bool of each, whether it is there: an object that is not adds to no other.

    Returns:
        The ratios with these gains.
    """
    scale, gain, explained = (torch.stack(part) for part in zip(*ratios, strict=True))  # (O, B)
    counts = torch.stack([*present]).to(scale.device) & (explained > _EXPLAINED)
    same = (scale[:, None].log() - scale.log()).abs() < _TOLERANCE  # (O, O, B), not of nan
    others = ~torch.eye(len(scale), dtype=torch.bool, device=scale.device)[..., None]
    pooled = gain + (gain * (same & others & counts)).sum(1)
    return [one._replace(gain=total) for one, total in zip(ratios, pooled, strict=True)]


class _Seen(NamedTuple):
    """The cells that show the object in one image."""

    member: Tensor  # (n,) probability that it is the object
    share: Tensor  # (n, k) log-probabilities of the fragments
    points: Tensor  # (n, k, 3) the object point in each, from the center, in radii
    measured: Tensor  # (n, 3) camera points [m]


def _seen(coordinates: Coordinates, cells: Cells, image: int) -> _Seen:
    """Return the cells of one image that the network takes for the object."""
    member = torch.sigmoid(coordinates.logit[image]).flatten()
    which = ((member > 0.5) & cells.valid[image].flatten()).nonzero()[:, 0]
    which = which[:: max(1, math.ceil(len(which) / _CELLS))]
    maps = coordinates.log_prob, coordinates.position, cells.point
    share, points, measured = (x[image].flatten(0, 1)[which] for x in maps)
    return _Seen(member[which], share, points, measured)


def _measure(pose: Tensor, seen: _Seen, object_model: ObjectModel) -> tuple[Tensor, Tensor, Tensor]:
    """Return scale, gain and share of one image."""
    member, share, points, measured = seen
    if len(member) < _FEWEST or not bool(pose.isfinite().all()):
        return pose.new_tensor(math.nan), pose.new_zeros(()), pose.new_zeros(())
    exponents = torch.linspace(math.log(_LEAST), math.log(_MOST), _STEPS, device=pose.device)
    scales = exponents.exp().to(pose)  # 1 is the middle one
    turned = scales[:, None, None, None] * (points @ rotation_of(pose).mT)  # (S, cells, K, 3)
    away = measured[:, None] / object_model.radius - turned  # where each fragment puts the center
    center = origin_of(pose, object_model.center.to(pose)) / object_model.radius
    center = center.expand(len(scales), 3)
    for _ in range(_ROUNDS):
        each = share - (away - center[:, None, None]).square().sum(-1) / (2 * _NOISE**2)
        whole = each.logsumexp(-1)
        belongs = member * torch.sigmoid(whole - _OUTLIER)
        weight = torch.softmax(each, dim=-1) * belongs[..., None]
        total = weight.sum((1, 2))[:, None].clamp_min(1e-6)
        center = (weight[..., None] * away).sum((1, 2)) / total
    each = share - (away - center[:, None, None]).square().sum(-1) / (2 * _NOISE**2)
    whole = each.logsumexp(-1)
    profile = (member * torch.logaddexp(whole, whole.new_tensor(_OUTLIER))).sum(1)
    top = profile.argmax()
    explained = (whole[top] > _OUTLIER).to(pose).mean()
    return scales[top], profile[top] - profile[_STEPS // 2], explained
