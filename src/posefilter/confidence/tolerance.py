"""How far an estimate may be off and still be right: by default ADD below 0.1 diameters, or a
tolerance of the user's own, such as what a gripper allows.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from functools import reduce
from operator import and_
from typing import Any, NamedTuple

import torch
from torch import Tensor

from posefilter.errors import UserError, check_positive
from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.geometry.rotation import angle_between
from posefilter.geometry.symmetries import densify, list_equivalent
from posefilter.types import ObjectModel


class PoseErrors(NamedTuple):
    """Errors of B estimates, up to the object's symmetries: (B,) each, tensors or arrays."""

    translation: Any  # of the object's center [m]
    rotation: Any  # [rad]
    add: Any  # [diameters]
    add_s: Any  # [diameters]


@dataclass(frozen=True)
class PoseTolerance:
    """What an estimate has to keep to be right: all of what is given.

    Errors are to the pose that the object's symmetries make of the truth and that is nearest by
    ADD. ADD-S asks where the surface lies, and not which way the object is turned where its shape
    hardly tells, as of a can about its axis or of a mug whose handle is hidden.

    Attributes:
        translation_mm: Largest error of the object's center [mm].
        rotation_deg: Largest error of the rotation [degrees].
        add: Largest ADD [diameters].
        add_s: Largest ADD-S [diameters].

    Raises:
        UserError: None is given, or one is no positive number.
    """

    translation_mm: float | None = None
    rotation_deg: float | None = None
    add: float | None = None
    add_s: float | None = None

    def __post_init__(self) -> None:
        """Check the numbers."""
        given = {key: value for key, value in asdict(self).items() if value is not None}
        for key, value in given.items():
            check_positive(f"pose_tolerance.{key}", value)
        if not given:
            names = ", ".join(field.name for field in fields(self))
            raise UserError(f"pose_tolerance: gives none of {names}")

    def accepts(self, errors: PoseErrors) -> Any:
        """Return which estimates keep it, (B,) bool, of tensors or arrays alike."""
        limits = (
            None if self.translation_mm is None else self.translation_mm / 1000,
            None if self.rotation_deg is None else math.radians(self.rotation_deg),
            self.add,
            self.add_s,
        )
        pairs = zip(errors, limits, strict=True)
        return reduce(and_, (error < limit for error, limit in pairs if limit is not None))

    def describe(self) -> str:
        """Return it in a few words: `within 5 mm and 10 degrees`."""
        said = {
            "translation_mm": "{:g} mm",
            "rotation_deg": "{:g} degrees",
            "add": "ADD {:g} d",
            "add_s": "ADD-S {:g} d",
        }
        given = [(said[key], value) for key, value in asdict(self).items() if value is not None]
        return f"within {' and '.join(text.format(value) for text, value in given)}"


RIGHT = PoseTolerance(add=0.1)  # what `probability` is of


def check_pose_tolerance(given: object) -> None:
    """Raise UserError unless a tolerance is one, or None."""
    if not isinstance(given, PoseTolerance | None):
        raise UserError(f"pose_tolerance={given!r}: expected posefilter.PoseTolerance(...)")


def read_pose_tolerance(given: Mapping[str, Any] | None) -> PoseTolerance | None:
    """Return the tolerance of a configuration; None where all of it is null."""
    if given is None or all(value is None for value in given.values()):
        return None
    return PoseTolerance(**given)


def measure_pose_errors(poses: Tensor, truth: Tensor, object_model: ObjectModel) -> PoseErrors:
    """Return how far estimates are off, up to symmetries; a continuous one has no gaps.

    Args:
        poses: (B, 4, 4) camera_from_object [m]; one that is not finite is infinitely far off.
        truth: (B, 4, 4).
        object_model: The object.
    """
    from posefilter.metrics.errors import add, add_s  # trees of scipy, prediction needs none

    truth, points = truth.to(poses), object_model.points.to(poses)
    known = poses.isfinite().flatten(1).all(1)
    poses = torch.where(known[:, None, None], poses, truth)
    equal = list_equivalent(poses, truth, densify(object_model.symmetries.double()))
    distances = add(poses[:, None], equal, points)
    least, which = distances.min(1)
    near = equal[torch.arange(len(equal)), which]
    center = object_model.center.to(poses)
    errors = (
        (origin_of(poses, center) - origin_of(near, center)).norm(dim=-1),
        angle_between(rotation_of(poses), rotation_of(near)),
        least / object_model.diameter,
        add_s(poses, truth, points) / object_model.diameter,
    )
    return PoseErrors(*(one.masked_fill(~known, torch.inf) for one in errors))
