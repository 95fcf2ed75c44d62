"""The density of weighted poses on SE(3): a kernel density estimate whose kernels follow the poses.

Measure: a density is per cubic meter of position, and per unit of rotation where all of SO(3) has
the volume pi^2 (Murphy et al. 2021), so that the uniform rotation has density 1 / pi^2.  Which
point of the object is positioned does not matter.  Logarithms are natural.

Kernel of pose i: a Gaussian of twists, T = move_about(T_i, xi), xi ~ N(0, s^2 C_i), where C_i is
the covariance of the twists to its nearest neighbors (manifold Parzen windows, Vincent and Bengio
2003).  So kernels are long along a ring of poses, and narrow across it.  The number of neighbors
and the factor s are those of highest leave-one-out likelihood (Habbema et al. 1974).  A hundredth
of the mass is a background: any rotation, and a position that is Cauchy about the mean with the
object's diameter as its scale.  The density is positive everywhere, and integrates to 1.

References:
    Habbema, Hermans, van den Broek: A stepwise discriminant analysis program using density
        estimation. COMPSTAT (1974).
    Vincent, Bengio: Manifold Parzen windows. NIPS 15 (2003).
    Murphy et al.: Implicit-PDF. ICML (2021).
"""

import math
from typing import NamedTuple

import torch
from torch import Generator, Tensor

from posefilter.geometry.pose import move_about
from posefilter.geometry.pose_kernels import (
    TwistParts,
    measure_modes,
    measure_neighbors,
    pair_twists,
    split_poses,
    whiten_kernels,
)
from posefilter.geometry.symmetries import densify, gather_copies, spread_turns

BACKGROUND = 0.01  # of the mass
_SHARES = (0.1, 0.3, 1.0)  # of the poses that are neighbors
_FACTORS = (0.25, 0.35, 0.5, 0.7, 1.0)
_FEWEST = 40  # neighbors
_NARROWEST = 5e-4  # [diameters] standard deviation
_LOG_UNITS = math.log(8.0)  # from rotation vectors, in which SO(3) has the volume 8 pi^2
_LOG_NONE = math.log(1e-12)  # where one pose has all the weight
_JUDGED = 250  # heaviest poses, that the kernels' widths are chosen by
_CHUNK = 1 << 17  # pairs of poses held at once


class PoseDensity(NamedTuple):
    """A density over poses; made by `fit_density`, evaluated by `log_density`."""

    chosen: Tensor  # (N,) which of the poses that were given have a kernel; of copies the first
    matrices: Tensor  # (N, 4, 4) their poses, or copies of them that symmetries make
    poses: TwistParts  # the same
    log_weights: Tensor  # (N,), normalized
    whiten: Tensor  # (N, 6, 6) maps a twist of a kernel to a standard normal vector
    log_scale: Tensor  # (N,) log of the kernels' normalization
    symmetries: Tensor  # (S, 4, 4) object_from_object
    center: Tensor  # (3,) of the object, in its frame [m]
    mean: Tensor  # (3,) position of the background [m]
    diameter: float  # its scale [m]


def fit_density(
    poses: Tensor,
    log_weights: Tensor,
    center: Tensor,
    radius: float,
    diameter: float,
    symmetries: Tensor | None = None,
    max_kernels: int = 2000,
    member: Tensor | None = None,
) -> PoseDensity:
    """Fit a kernel density to weighted poses.

    Poses that are the same, which resampling makes, have one kernel of their weight: they tell no
    more of the distribution than one does.

    Args:
        poses: (N, 4, 4) camera_from_object [m].
        log_weights: (N,), normalized.
        center: (3,) the object's center in its frame [m].
        radius: Distance at which a turn counts as the shift that it causes [m].
        diameter: Of the object [m].
        symmetries: (S, 4, 4) object_from_object, a group: a pose and what a symmetry makes of it
            are one, and share the density equally.  Turns that stand for a continuous symmetry
            count as all that lie between them.  None: the identity alone.
        max_kernels: Number of kernels.  Of more poses the heaviest have kernels of their own, and
            an even selection of the others stands for these.
        member: (N,) int64, the mode of each pose.  A kernel's covariance may then be that of its
            mode, too, however few poses the mode has, if the likelihood says so.

    Returns:
        The density, in float64.
    """
    poses, log_weights, center = poses.double(), log_weights.double(), center.to(poses).double()
    group = torch.eye(4)[None] if symmetries is None else symmetries
    group = group.to(poses)
    first, log_weights = _merge(poses, log_weights)
    kept, log_weights = _thin(log_weights, max_kernels)
    chosen = first[kept]
    poses = poses[chosen]
    dense = densify(group)
    if len(dense) > len(group):  # however the poses are turned about the axis
        about = poses[log_weights.argmax()]
        poses = spread_turns(gather_copies(poses, about, center, radius, dense), group)
    canonical = gather_copies(poses, poses[log_weights.argmax()], center, radius, group)
    parts = split_poses(canonical, center)
    mean = (log_weights.exp()[:, None] * parts.center).sum(0)
    fixed = (group, center, mean, diameter)
    unit = poses.new_tensor([1.0] * 3 + [radius] * 3)
    count = len(poses)
    judged = log_weights.topk(min(count, _JUDGED)).indices
    twist = pair_twists(parts, parts.select(judged))
    share = log_weights[judged].softmax(0)
    best, highest = None, -math.inf
    counts = sorted({min(count, max(_FEWEST, round(s * count))) for s in _SHARES})
    shapes = measure_neighbors(parts, log_weights.exp(), counts, unit)
    if member is not None:
        shapes.append(measure_modes(parts, log_weights.exp(), member[chosen], unit))
    for shape in shapes:
        shape = shape + (_NARROWEST * diameter) ** 2 * torch.eye(6).to(shape)
        whiten, log_scale = whiten_kernels(shape / (unit[:, None] * unit))
        kernels = PoseDensity(chosen, canonical, parts, log_weights, whiten, log_scale, *fixed)
        square, log_volume = _measure(kernels, twist)
        for factor in _FACTORS:
            scale = log_scale - 6 * math.log(factor)
            log_kernel = scale[:, None] - 0.5 / factor**2 * square - log_volume
            # the copies that symmetries make are far, or nearly alike: left out of the choice
            log_p = _mix(kernels, log_kernel, parts.center[judged, None], judged)
            score = float((share * log_p).sum())
            if score > highest:
                best = kernels._replace(whiten=whiten / factor, log_scale=scale)
                highest = score
    assert best is not None
    return best


def log_density(density: PoseDensity, poses: Tensor) -> Tensor:
    """Return the log density at poses [1 / m^3, and SO(3) of volume pi^2].

    (M, 4, 4) -> (M,) float64.
    """
    poses = poses.to(density.center)
    rows = max(1, _CHUNK // (len(density.log_weights) * len(density.symmetries)))
    return torch.cat([_evaluate(density, some, None) for some in poses.split(rows)])


def log_density_held_out(density: PoseDensity) -> Tensor:
    """Return the log density at the kernels' own poses, each without its own kernel.

    A kernel is highest at its own pose, so that with it a pose of the fit would seem likelier than
    a new one of the same distribution.

    -> (N,) float64.
    """
    rows = max(1, _CHUNK // (len(density.chosen) * len(density.symmetries)))
    every = torch.arange(len(density.chosen), device=density.chosen.device)
    parts = [_evaluate(density, density.matrices[own], own) for own in every.split(rows)]
    return torch.cat(parts)


def _evaluate(density: PoseDensity, poses: Tensor, own: Tensor | None) -> Tensor:
    """Return the log density at poses (M, 4, 4), without the kernels `own` (M,).  -> (M,)."""
    copies = poses[:, None] @ density.symmetries
    at = split_poses(copies.flatten(0, 1), density.center)
    square, log_volume = _measure(density, pair_twists(density.poses, at))
    log_kernel = density.log_scale[:, None] - 0.5 * square - log_volume
    copies_of = len(density.symmetries)
    log_kernel = log_kernel.unflatten(1, (-1, copies_of)).logsumexp(2) - math.log(copies_of)
    return _mix(density, log_kernel, at.center.unflatten(0, (-1, copies_of)), own)


def _mix(density: PoseDensity, log_kernel: Tensor, center: Tensor, own: Tensor | None) -> Tensor:
    """Return the log density of the mixture at M poses.

    Args:
        density: The kernels.
        log_kernel: (N, M) log densities of the kernels there.
        center: (M, S, 3) positions there, of each copy that symmetries make.
        own: (M,) the kernel of each pose, which is left out; None: none is.

    Returns:
        (M,).
    """
    joint = density.log_weights[:, None] + log_kernel
    if own is None:
        return _with_background(density, joint.logsumexp(0), center - density.mean)
    joint[own, torch.arange(len(own), device=own.device)] = -torch.inf
    others = (-density.log_weights[own].exp().clamp_max(1)).log1p().clamp_min(_LOG_NONE)
    return _with_background(density, joint.logsumexp(0) - others, center - density.mean)


def _with_background(density: PoseDensity, log_mixture: Tensor, offset: Tensor) -> Tensor:
    """Mix a log density (M,) with the background at offsets (M, S, 3) of the copies.  -> (M,)."""
    ratio = offset.square().sum(-1) / density.diameter**2
    # a Cauchy distribution in 3-D, 1 / (pi^2 s^3 (1 + r^2 / s^2)^2), times 1 / pi^2
    cauchy = -2 * ratio.log1p() - 3 * math.log(density.diameter) - 4 * math.log(math.pi)
    background = cauchy.logsumexp(1) - math.log(offset.shape[1]) + math.log(BACKGROUND)
    return torch.logaddexp(log_mixture + math.log1p(-BACKGROUND), background)


def _measure(density: PoseDensity, twist: Tensor) -> tuple[Tensor, Tensor]:
    """Return the squared length of whitened twists, and the log volume of a unit of their space.

    (N, M, 6) -> (N, M) x 2.
    """
    square = (twist @ density.whiten.mT).square_().sum(-1)
    angle = twist[..., 3:].norm(dim=-1)
    # dR = 2 (1 - cos a) / a^2 d(rotation vector) = sinc^2(a / 2) d(rotation vector)
    half = torch.sinc(angle / (2 * math.pi)).clamp_min(1e-9)
    return square, 2 * half.log() - _LOG_UNITS


def _merge(poses: Tensor, log_weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the first of each kind of equal poses (N, 4, 4), in order, and its log weight."""
    kind = poses.flatten(1).unique(dim=0, return_inverse=True)[1]
    every = torch.arange(len(kind), device=kind.device)
    count = int(kind.max()) + 1
    if count == len(kind):
        return every, log_weights
    first = torch.full_like(every[:count], len(kind)).scatter_reduce(0, kind, every, "amin")
    first, order = first.sort()
    weights = log_weights.new_zeros(count).index_add(0, kind, log_weights.exp())
    return first, weights[order].log()


def _thin(log_weights: Tensor, max_kernels: int) -> tuple[Tensor, Tensor]:
    """Return which poses have kernels, and the log weights of these, which sum to 1."""
    count = len(log_weights)
    if count <= max_kernels:
        return torch.arange(count, device=log_weights.device), log_weights
    order = log_weights.argsort(descending=True, stable=True)
    heavy, rest = order[: max_kernels // 2], order[max_kernels // 2 :]
    every = torch.linspace(0, len(rest) - 1, max_kernels // 2, device=rest.device).round().long()
    few = rest[every]
    stands_for = (log_weights[rest].logsumexp(0) - log_weights[few].logsumexp(0)).nan_to_num(0.0)
    shares = torch.cat([log_weights[heavy], log_weights[few] + stands_for])
    return torch.cat([heavy, few]), shares.log_softmax(0)


def widen(density: PoseDensity, factor: float) -> PoseDensity:
    """Return the density with kernels that are wider by a factor, turns up to where they would
    wrap round.
    """
    covariance = factor**2 * measure_kernels(density)
    whiten, log_scale = whiten_kernels(covariance)
    return density._replace(whiten=whiten, log_scale=log_scale)


def measure_kernels(density: PoseDensity) -> Tensor:
    """Return the covariances of the kernels' twists.  -> (N, 6, 6) [m^2, m rad, rad^2]."""
    root = torch.linalg.inv(density.whiten)
    return root @ root.mT


def draw_poses(density: PoseDensity, count: int, generator: Generator) -> Tensor:
    """Draw poses from a density's kernels, not from its background.

    Of symmetric objects only the copies of the kernels themselves are drawn.

    Args:
        density: Of poses.
        count: Number of poses.
        generator: Source of randomness, on the density's device.

    Returns:
        (count, 4, 4) camera_from_object [m], float64.
    """
    device, dtype = density.center.device, density.center.dtype
    # systematic: one uniform number decides where all strata are hit
    start = torch.rand((), generator=generator, device=device, dtype=dtype)
    position = (torch.arange(count, device=device, dtype=dtype) + start) / count
    kernel = torch.searchsorted(density.log_weights.exp().cumsum(0), position)
    kernel = kernel.clamp(max=len(density.log_weights) - 1)
    noise = torch.randn(count, 6, generator=generator, device=device, dtype=dtype)
    twist = torch.linalg.solve_triangular(density.whiten[kernel], noise[..., None], upper=False)
    return move_about(density.matrices[kernel], twist[..., 0], density.center)
