"""What a belief comes to, in few numbers: axis by axis, in words, and in the image."""

import math
from dataclasses import dataclass, field
from numbers import Real

import numpy as np
import torch
from torch import Tensor

from posefilter.errors import UserError
from posefilter.geometry.camera import project
from posefilter.geometry.pose import origin_of, rotation_of, transform
from posefilter.geometry.rotation import angle_between

AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class Mode:
    """One of the poses round which a belief gathers.

    Attributes:
        pose: The densest particle (4, 4), camera_from_object [m].
        mass: Its share of the belief, in (0, 1].
        covariance: Of its own particles about their mean pose (6, 6); see `Belief.covariance`.
        equivalent: Index of a heavier mode that one of the object's symmetries makes of this one,
            within a tenth of the diameter; None where there is none.
    """

    pose: np.ndarray
    mass: float
    covariance: np.ndarray
    equivalent: int | None = None


@dataclass(frozen=True, eq=False)
class Marginal:
    """The distribution of one axis of a belief.

    Attributes:
        axis: `x`, `y`, `z`: the object's center in the camera's axes [m]; `rx`, `ry`, `rz`: the
            rotation vector from the mean pose, in the object's own axes [rad].
        values: Of the particles (N,).
        weights: Their weights (N,), which sum to 1.
    """

    axis: str
    values: np.ndarray = field(repr=False)
    weights: np.ndarray = field(repr=False)

    @property
    def mean(self) -> float:
        """The weighted mean."""
        return float(self.weights @ self.values)

    @property
    def std(self) -> float:
        """The weighted standard deviation."""
        return math.sqrt(max(0.0, float(self.weights @ np.square(self.values - self.mean))))

    @property
    def deviation(self) -> float:
        """The earlier name of `std`."""
        return self.std

    def quantile(self, q: float) -> float:
        """Return the least value that at least a fraction `q` of the weight does not exceed.

        Raises:
            UserError: `q` is not in [0, 1].
        """
        return find_quantile(self.values, self.weights, q)

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Return the central interval that holds `level` of the weight.

        Raises:
            UserError: The level is not in [0, 1].
        """
        check_probability("level", level)
        rest = (1 - level) / 2
        return self.quantile(rest), self.quantile(1 - rest)


@dataclass(frozen=True)
class Uncertainty:
    """How far the particles of a mode, and of those that are equivalent to it, are from it.

    Attributes:
        level: Share of their weight that is meant, such as 0.95.
        translation: Distance of the object's center that this share does not exceed [m].
        rotation: Angle that this share does not exceed [rad], the least of what symmetries allow.
        mass: Their share of the belief.
    """

    level: float
    translation: float
    rotation: float
    mass: float

    @property
    def shift(self) -> float:
        """The earlier name of `translation`."""
        return self.translation

    @property
    def turn(self) -> float:
        """The earlier name of `rotation`."""
        return self.rotation

    def describe(self) -> str:
        """Return it in words: `within 4.2 mm and 3.1 degrees (95 %)`."""
        rotation = math.degrees(self.rotation)
        angle = f"{rotation:.1f}" if rotation < 10 else f"{rotation:.0f}"
        distance = f"{1000 * self.translation:.1f}"
        words = f"within {distance} mm and {angle} degrees ({100 * self.level:g} %)"
        if self.mass > 0.995:
            return words
        return f"{words} of a pose that has {100 * self.mass:.0f} % of the belief"


@dataclass(frozen=True, eq=False)
class Projection:
    """Where a belief puts points of the object in the image.

    Attributes:
        mean: (P, 2) [px].
        covariance: (P, 2, 2) [px^2].
        radius: (P,) distance from the mean that `level` of the weight does not exceed [px].
        level: That share.
    """

    mean: np.ndarray
    covariance: np.ndarray
    radius: np.ndarray
    level: float


def find_quantile(values: np.ndarray, weights: np.ndarray, q: float) -> float:
    """Return the least value that at least a fraction `q` of the weight does not exceed.

    Args:
        values: (N,).
        weights: (N,) that sum to 1.
        q: In [0, 1].

    Raises:
        UserError: `q` is not in [0, 1].
    """
    check_probability("quantile q", q)
    order = np.argsort(values, kind="stable")
    mass = np.cumsum(weights[order])
    return float(values[order][min(int(np.searchsorted(mass, q - 1e-9)), len(values) - 1)])


def check_probability(name: str, value: float) -> None:
    """Raise UserError unless a quantile or level, which the message names, is in [0, 1]."""
    if not isinstance(value, Real | np.generic) or not 0 <= value <= 1:
        raise UserError(f"belief: the {name} is between 0 and 1, and {value!r} is not")


def measure_uncertainty(
    samples: Tensor,
    weights: Tensor,
    pose: Tensor,
    mass: float,
    center: Tensor,
    symmetries: Tensor,
    level: float,
) -> Uncertainty:
    """Return how far particles are from a pose.

    Args:
        samples: (N, 4, 4) [m].
        weights: (N,) that sum to 1.
        pose: (4, 4).
        mass: Share of the belief that the particles have.
        center: (3,) of the object [m].
        symmetries: (S, 4, 4) object_from_object.
        level: Share of the weight that is meant.
    """
    check_probability("level", level)
    copies = pose @ symmetries
    rotation, nearest = angle_between(rotation_of(samples)[:, None], rotation_of(copies)).min(1)
    translation = (origin_of(samples, center) - origin_of(copies, center)[nearest]).norm(dim=-1)
    share = weights.numpy()
    return Uncertainty(
        level,
        find_quantile(translation.numpy(), share, level),
        find_quantile(rotation.numpy(), share, level),
        mass,
    )


def project_belief(
    samples: Tensor, weights: Tensor, points: Tensor, intrinsics: Tensor, level: float
) -> Projection:
    """Return where particles put points in the image.

    (N, 4, 4), (N,), (P, 3) [m], (3, 3) [px] -> Projection.
    """
    check_probability("level", level)
    pixels = project(transform(samples, points), intrinsics)
    share = weights[:, None, None]
    mean = (share * pixels).sum(0)
    offset = pixels - mean
    covariance = torch.einsum("n,npi,npj->pij", weights, offset, offset)
    far = offset.norm(dim=-1).numpy()
    radius = [find_quantile(one, weights.numpy(), level) for one in far.T]
    return Projection(mean.numpy(), covariance.numpy(), np.array(radius), level)
