"""torchmetrics classes: `update` with a batch, `compute` at the end, over all processes."""

from collections.abc import Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities.data import dim_zero_cat

from posefilter.geometry.boxes import box_iou
from posefilter.geometry.pose_error import subsample
from posefilter.geometry.spaces import PoseSpace
from posefilter.geometry.symmetries import densify
from posefilter.metrics.beliefs import entropy, mass_within, on_object, rank_of_truth, spread
from posefilter.metrics.errors import NearestPoint, add, add_s, add_up_to_symmetry
from posefilter.metrics.scores import InstanceErrors, summarize_errors
from posefilter.types import BeliefBatch, ObjectModel

# of visibility; lower end included, upper only at 1
RANGES = ((0.0, 0.3), (0.3, 0.5), (0.5, 0.8), (0.8, 1.0), (0.5, 1.0), (0.6, 1.0))

Columns = TypeVar("Columns", bound=tuple[Tensor, ...])


def concat_state(state: Any) -> Tensor:
    """Return a list state as one tensor, empty if nothing was accumulated."""
    return dim_zero_cat(state) if len(state) else torch.zeros(0, dtype=torch.float64)


class Rows(Metric, Generic[Columns]):
    """Base of metrics that keep a row of numbers an image, in the columns of a NamedTuple."""

    full_state_update = False
    columns: type[Any]  # the NamedTuple
    rows: list[Tensor]  # of each batch (B, columns) float64

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_state("rows", default=[], dist_reduce_fx="cat")

    def append(self, columns: Columns) -> None:
        """Accumulate the rows of a batch: columns of (B,)."""
        self.rows.append(torch.stack([column.double() for column in columns], dim=1))

    def last(self) -> Columns:
        """Return the columns of the batch that was accumulated last, (B,) each."""
        columns: Columns = self.columns(*self.rows[-1].T)
        return columns

    def all(self) -> Columns:
        """Return the columns of all images, (N,) each."""
        rows = concat_state(self.rows).reshape(-1, len(self.columns._fields))
        columns: Columns = self.columns(*rows.T)
        return columns


class PoseErrors(Rows[InstanceErrors]):
    """ADD and ADD-S of all instances, and ADD up to symmetry where an object has symmetries;
    missed ones and poses that are not finite have infinite error.

    Args:
        models: The objects.
        **kwargs: Arguments of torchmetrics.Metric.
    """

    columns = InstanceErrors

    def __init__(self, models: Sequence[ObjectModel], **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.models = list(models)
        self.trees = [NearestPoint(model.points) for model in models]
        self.symmetries = [densify(model.symmetries.double()) for model in models]

    def update(self, poses: Tensor, truth: Tensor, object_id: Tensor | None = None) -> None:
        """Accumulate errors, in the order of the instances.

        Args:
            poses: (B, 4, 4) estimates, camera_from_object [m].
            truth: (B, 4, 4) true poses.
            object_id: (B,) index into `models`; the only one if None.
        """
        ids = [0] * len(truth) if object_id is None else object_id.tolist()
        finite = poses.isfinite().flatten(1).all(1)
        missed = torch.full((4, len(truth)), torch.inf, dtype=torch.float64, device=truth.device)
        errors = InstanceErrors(*missed)
        for index in sorted(set(ids)):
            selected = torch.tensor([i == index for i in ids], device=truth.device)
            measured = selected & finite
            model, tree = self.models[index], self.trees[index]
            a, b = poses[measured].double(), truth[measured].double()
            errors.add[measured] = add(a, b, model.points)
            errors.add_s[measured] = add_s(a, b, tree)
            errors.diameter[selected] = model.diameter
            errors.add_up_to_symmetry[measured] = add_up_to_symmetry(
                a, b, model.points, self.symmetries[index]
            )
        self.append(errors)

    def compute(self) -> dict[str, Any]:
        """Return {"instances", "missed", "add": {...}, "add_s": {...}} as in metrics.json, with
        "add_up_to_symmetry" where an object has symmetries.
        """
        errors = self.all()
        missed = int(errors.add.isinf().sum())
        blocks = summarize_errors(errors, have_symmetries(self.models))
        return {"instances": len(errors.add), "missed": missed, **blocks}


def have_symmetries(models: Sequence[ObjectModel]) -> bool:
    """Return whether any of the objects has symmetries."""
    return any(len(model.symmetries) > 1 for model in models)


def lies_within(visible: Tensor, low: float, high: float) -> Tensor:
    """Tell which visible shares (N,) lie in a range: its lower end does, its upper only at 1."""
    return (visible >= low) & ((visible < high) if high < 1 else (visible <= 1))


class VisibleErrors(NamedTuple):
    """`InstanceErrors` and the share of each instance that is visible: (N,) each."""

    add: Tensor
    add_s: Tensor
    diameter: Tensor
    add_up_to_symmetry: Tensor
    visibility: Tensor

    def select(self, which: Tensor) -> InstanceErrors:
        """Return the errors of some instances, (N,) bool."""
        return InstanceErrors(*(getattr(self, name)[which] for name in InstanceErrors._fields))


class ErrorsByVisibility(Rows[VisibleErrors]):
    """ADD and ADD-S of the instances in each range of visibility: means over all images hide the
    effect of occlusion. Unknown visibility is in none.

    Args:
        models: The objects.
        ranges: Lower (inclusive) and upper ends (exclusive, except 1).
        **kwargs: Arguments of torchmetrics.Metric.
    """

    columns = VisibleErrors

    def __init__(
        self,
        models: Sequence[ObjectModel],
        ranges: Sequence[tuple[float, float]] = RANGES,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        self.models, self.ranges = list(models), tuple(ranges)

    def update(self, errors: InstanceErrors, visibility: Tensor) -> None:
        """Accumulate the errors of B instances with their visible shares (B,)."""
        self.append(VisibleErrors(*errors, visibility.to(errors.add)))

    def compute(self) -> dict[str, Any]:
        """Return {"0.3-0.5": {"instances", "add": {...}, "add_s": {...}}, ...} without empty
        ranges.
        """
        errors, symmetric = self.all(), have_symmetries(self.models)
        out = {}
        for low, high in self.ranges:
            selected = lies_within(errors.visibility, low, high)
            if bool(selected.any()):
                blocks = summarize_errors(errors.select(selected), symmetric)
                out[f"{low:g}-{high:g}"] = {"instances": int(selected.sum()), **blocks}
        return out


class Average(Metric):
    """Base of metrics that average one number of each image."""

    full_state_update = False
    total: Tensor
    count: Tensor

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    def collect(self, values: Tensor) -> None:
        """Accumulate (B,) values."""
        self.total += values.detach().double().sum()
        self.count += values.numel()

    def compute(self) -> Tensor:
        """Return the mean; NaN without images."""
        return self.total / self.count


class BoxIoU(Average):
    """Mean intersection over union of bounding boxes (the paper, section 4.1)."""

    def update(self, boxes: Tensor, truth: Tensor) -> None:
        """Accumulate (B, 4) boxes twice, (left, top, right, bottom) [px]; an empty box is a
        miss.
        """
        self.collect(box_iou(boxes, truth))


class ParticlesOnObject(Average):
    """Mean share of the particles on the object's visible mask."""

    def update(self, mask: Tensor, pixels: Tensor) -> None:
        """Accumulate (B, 1, H, W) bool masks and (B, N, 2) particles [px]."""
        self.collect(on_object(mask, pixels))


class BeliefColumns(NamedTuple):
    """Uncertainty and calibration of N beliefs: (N,) each."""

    entropy: Tensor  # of the weights [nat]
    effective_particles: Tensor  # 1 / sum w^2
    spread_m: Tensor  # of the centers about that of the mean pose
    spread_rad: Tensor  # of the rotations about that of the mean pose
    mass_01d: Tensor  # weight of the poses with ADD below 0.1 diameters
    mass_2cm: Tensor  # and below 2 cm
    rank: Tensor  # of the truth by its mean distance to the particles; mean 0.5 if calibrated


class BeliefQuality(Rows[BeliefColumns]):
    """Uncertainty and calibration of beliefs.

    The means of `BeliefColumns`. distance_coverage_50, distance_coverage_90: percentage of images
    whose rank is at most 0.5 and 0.9 (50 and 90 if calibrated, less if overconfident); of
    highest-density sets see `Credibility`.

    Args:
        object_model: The object.
        points: Number of points of ADD.
        **kwargs: Arguments of torchmetrics.Metric.
    """

    columns = BeliefColumns

    def __init__(self, object_model: ObjectModel, points: int = 256, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.space = PoseSpace(tuple(object_model.center.tolist()), object_model.radius)
        self.distances = (0.1 * object_model.diameter, 0.02)
        self.points = subsample(object_model.points, points)

    def update(self, belief: BeliefBatch, truth: Tensor) -> None:
        """Accumulate B beliefs, with the true poses (B, 4, 4)."""
        poses, log_w = belief.poses, belief.log_weights
        spread_m, spread_rad = spread(poses, log_w, self.space)
        mass_01d, mass_2cm = (
            mass_within(poses, log_w, truth, self.points, d) for d in self.distances
        )
        self.append(
            BeliefColumns(
                entropy=entropy(log_w),
                effective_particles=1 / log_w.exp().square().sum(1),
                spread_m=spread_m,
                spread_rad=spread_rad,
                mass_01d=mass_01d,
                mass_2cm=mass_2cm,
                rank=rank_of_truth(poses, log_w, truth, self.space),
            )
        )

    def compute(self) -> dict[str, float]:
        """Return the mean of each metric; empty without images."""
        if not len(self.rows):
            return {}
        means = concat_state(self.rows).mean(0).tolist()
        out = dict(zip(BeliefColumns._fields, means, strict=True))
        rank = self.all().rank
        for percent in (50, 90):
            inside = (rank <= percent / 100).double().mean()
            out[f"distance_coverage_{percent}"] = float(100 * inside)
        return out
