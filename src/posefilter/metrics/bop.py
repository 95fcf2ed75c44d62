"""The pose errors of the BOP challenge that know symmetries: MSSD and MSPD (Hodan et al. 2020, "BOP
Challenge 2020 on 6D Object Localization").

The third error of the challenge is in `vsd.py`, their average recall in `bop_recall.py`.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from posefilter.geometry.camera import project
from posefilter.geometry.pose import transform
from posefilter.geometry.symmetries import densify, list_equivalent
from posefilter.metrics.collect import Rows
from posefilter.metrics.scores import median
from posefilter.types import ObjectModel

# shares of the diameter, and pixels in an image 640 wide, below which an error counts as correct
MSSD_THRESHOLDS = tuple(0.05 * i for i in range(1, 11))
MSPD_THRESHOLDS = tuple(5.0 * i for i in range(1, 11))
REFERENCE_WIDTH = 640


def mssd(poses: Tensor, truth: Tensor, symmetries: Tensor, points: Tensor) -> Tensor:
    """Return the maximum symmetry-aware surface distance: of the symmetries the least of the
    greatest distances between corresponding points.

    Args:
        poses: (*, 4, 4) estimates, camera_from_object [m].
        truth: (*, 4, 4) true poses.
        symmetries: (S, 4, 4) object_from_object, the identity among them.
        points: (P, 3) of the object [m]; the greatest distance is always at a vertex of the convex
            hull.

    Returns:
        (*) [m].
    """
    return _least_of_greatest(poses, truth, symmetries, points, lambda camera, _: camera)


def mspd(
    poses: Tensor, truth: Tensor, symmetries: Tensor, points: Tensor, intrinsics: Tensor
) -> Tensor:
    """Return the maximum symmetry-aware projection distance: as `mssd`, between projections.

    Args:
        poses: (*, 4, 4) estimates, camera_from_object [m].
        truth: (*, 4, 4) true poses.
        symmetries: (S, 4, 4) object_from_object, the identity among them.
        points: (P, 3) of the object [m].
        intrinsics: (*, 3, 3) [px].

    Returns:
        (*) [px].
    """
    K = intrinsics.expand(*poses.shape[:-2], 3, 3).reshape(-1, 3, 3)
    return _least_of_greatest(
        poses, truth, symmetries, points, lambda camera, row: project(camera, K[row])
    )


def mspd_of_vertices(
    pose: Tensor,
    truth: Tensor,
    symmetries: Tensor,
    hull: Tensor,
    vertices: Tensor,
    intrinsics: Tensor,
) -> Tensor:
    """Return the `mspd` over all vertices, which are looked at where the hull leaves it open: by
    perspective, a nearer vertex inside of it may move by more pixels.

    Args:
        pose: (4, 4) estimate, camera_from_object [m].
        truth: (4, 4) true pose.
        symmetries: (S, 4, 4) object_from_object, the identity among them.
        hull: (H, 3) some of the vertices [m], such as those of the convex hull.
        vertices: (V, 3) of the object [m].
        intrinsics: (3, 3) [px].

    Returns:
        () [px].
    """

    def greatest(same: Tensor, points: Tensor) -> Tensor:
        guess = project(transform(pose, points), intrinsics)
        return (project(transform(same, points), intrinsics) - guess).norm(dim=-1).amax(-1)

    equivalent = list_equivalent(pose, truth.to(pose), symmetries)
    at_least = greatest(equivalent, hull)
    best = at_least.new_tensor(torch.inf)
    for row in at_least.argsort().tolist():
        if at_least[row] >= best:
            break
        best = torch.minimum(best, greatest(equivalent[row], vertices))
    return best


def _least_of_greatest(
    poses: Tensor,
    truth: Tensor,
    symmetries: Tensor,
    points: Tensor,
    view: Callable[[Tensor, int], Tensor],
) -> Tensor:
    """Return min over symmetries of max over points of the distance in a view of camera points."""
    lead = poses.shape[:-2]
    points = points.to(poses)
    out = poses.new_zeros(lead.numel())
    pairs = zip(poses.reshape(-1, 4, 4), truth.to(poses).reshape(-1, 4, 4), strict=True)
    for row, (pose, true) in enumerate(pairs):
        guess = view(transform(pose, points), row)
        same = view(transform(list_equivalent(pose, true, symmetries), points), row)
        out[row] = (same - guess).norm(dim=-1).amax(-1).amin(0)
    return out.view(lead)


def average_recall(errors: Tensor, thresholds: Sequence[float], unit: Tensor) -> float:
    """Return the mean over thresholds of the percentage of instances below.

    Args:
        errors: (N,).
        thresholds: In units of `unit`.
        unit: (N,), such as the diameters; in the unit of the errors.

    Returns:
        The average recall in [0, 100]; NaN without instances.
    """
    limits = unit[:, None] * torch.tensor(thresholds, dtype=unit.dtype, device=unit.device)
    return float(100 * (errors[:, None] < limits).double().mean())


class BopColumns(NamedTuple):
    """The errors of N instances, and the diameters of their objects: (N,) each."""

    mssd: Tensor  # [m]
    mspd: Tensor  # [px] of an image 640 wide
    diameter: Tensor  # [m]


class BopErrors(Rows[BopColumns]):
    """MSSD and MSPD of all instances; poses that are not finite have infinite error.

    Args:
        models: The objects.
        **kwargs: Arguments of torchmetrics.Metric.
    """

    columns = BopColumns

    def __init__(self, models: Sequence[ObjectModel], **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.models = list(models)
        self.symmetries = [densify(model.symmetries.double()) for model in models]
        # surface points alone would miss corners
        self.points = [torch.cat([model.hull, model.points]).double() for model in models]

    def update(
        self,
        poses: Tensor,
        truth: Tensor,
        intrinsics: Tensor,
        width: int,
        object_id: Tensor | None = None,
    ) -> None:
        """Accumulate errors.

        Args:
            poses: (B, 4, 4) estimates, camera_from_object [m].
            truth: (B, 4, 4) true poses.
            intrinsics: (B, 3, 3) [px].
            width: Of the images [px].
            object_id: (B,) index into `models`; the only one if None.
        """
        ids = [0] * len(truth) if object_id is None else object_id.tolist()
        missed = torch.full((3, len(truth)), torch.inf, dtype=torch.float64, device=truth.device)
        errors = BopColumns(*missed)
        for i, index in enumerate(ids):
            errors.diameter[i] = self.models[index].diameter
            if not bool(poses[i].isfinite().all()):
                continue
            pair = poses[i].double(), truth[i].double()
            shape = self.symmetries[index], self.points[index]
            errors.mssd[i] = mssd(*pair, *shape)
            pixels = mspd(*pair, *shape, intrinsics[i].double())
            errors.mspd[i] = pixels * REFERENCE_WIDTH / width
        self.append(errors)

    def compute(self) -> dict[str, dict[str, float]]:
        """Return {"mssd": {"ar", "median_mm"}, "mspd": {"ar", "median_px"}}, average recalls in [0,
        100]; pixels are those of an image 640 wide.
        """
        surface, pixels, diameter = self.all()
        return {
            "mssd": {
                "ar": average_recall(surface, MSSD_THRESHOLDS, diameter),
                "median_mm": 1000 * median(surface),
            },
            "mspd": {
                "ar": average_recall(pixels, MSPD_THRESHOLDS, torch.ones_like(pixels)),
                "median_px": median(pixels),
            },
        }
