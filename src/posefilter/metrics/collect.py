"""torchmetrics classes: `update` with a batch, `compute` at the end of a test, over all processes."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities.data import dim_zero_cat

from posefilter.geometry.boxes import box_iou
from posefilter.geometry.pose_error import thin
from posefilter.geometry.spaces import PoseSpace
from posefilter.metrics.beliefs import entropy, mass_within, on_object, rank_of_truth, spread
from posefilter.metrics.errors import NearestPoint, add, add_s
from posefilter.metrics.scores import summary
from posefilter.types import Belief, ObjectModel


def joined(state: Any) -> Tensor:
    """Return a list state as one tensor, empty where nothing was collected."""
    return dim_zero_cat(state) if len(state) else torch.zeros(0, dtype=torch.float64)


class PoseErrors(Metric):
    """ADD and ADD-S of every instance that was there; a missed one, or a pose that is not finite,
    is infinitely wrong.
    """

    full_state_update = False
    add: list[Tensor]
    add_s: list[Tensor]
    diameter: list[Tensor]

    def __init__(self, models: Sequence[ObjectModel], **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.models = list(models)
        self.trees = [NearestPoint(model.points) for model in models]
        for name in ("add", "add_s", "diameter"):
            self.add_state(name, default=[], dist_reduce_fx="cat")

    def update(
        self,
        poses: Tensor,
        truth: Tensor,
        object_id: Tensor | None = None,
        found: Tensor | None = None,
    ) -> None:
        """Collect (B, 4, 4) estimates and truths, camera_from_object [m]; errors are kept in their
        order.

        object_id (B,): index into `models` (the only one if None); found (B,) bool: False where
        there is no estimate.
        """
        ids = [0] * len(truth) if object_id is None else object_id.tolist()
        good = poses.isfinite().flatten(1).all(1)
        if found is not None:
            good = good & found
        errors = torch.full((3, len(truth)), torch.inf, dtype=torch.float64, device=truth.device)
        for index in sorted(set(ids)):
            here = torch.tensor([i == index for i in ids], device=truth.device)
            model, tree = self.models[index], self.trees[index]
            a, b = poses[here & good].double(), truth[here & good].double()
            errors[0, here & good] = add(a, b, model.points)
            errors[1, here & good] = add_s(a, b, tree)
            errors[2, here] = model.diameter
        for state, values in zip((self.add, self.add_s, self.diameter), errors, strict=True):
            state.append(values)

    def compute(self) -> dict[str, Any]:
        """Return {"instances", "missed", "add": {...}, "add_s": {...}} as metrics.json has them."""
        errors, diameter = joined(self.add), joined(self.diameter)
        return {
            "instances": len(errors),
            "missed": int(errors.isinf().sum()),
            "add": summary(errors, diameter),
            "add_s": summary(joined(self.add_s), diameter),
        }


class Average(Metric):
    """Base of metrics that are the mean of one number an image."""

    full_state_update = False
    total: Tensor
    count: Tensor

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    def collect(self, values: Tensor) -> None:
        """Take in (B,) values."""
        self.total += values.detach().double().sum()
        self.count += values.numel()

    def compute(self) -> Tensor:
        """Return the mean, NaN without images."""
        return self.total / self.count


class BoxIoU(Average):
    """Mean Jaccard index of bounding boxes (the paper, section 4.1)."""

    def update(self, boxes: Tensor, truth: Tensor) -> None:
        """Collect (B, 4) boxes twice, (left, top, right, bottom) [px]; an empty box is a miss."""
        self.collect(box_iou(boxes, truth))


class ParticlesOnObject(Average):
    """Mean share of the particles whose pixel is on the object's visible mask."""

    def update(self, mask: Tensor, pixels: Tensor) -> None:
        """Collect (B, 1, H, W) bool masks and (B, N, 2) particles [px]."""
        self.collect(on_object(mask, pixels))


class BeliefQuality(Metric):
    """How sure the beliefs are, and whether they have a right to be.

    entropy [nat] of the weights; effective_particles 1 / sum w^2; spread_m and spread_rad about the
    mean; mass_01d and mass_2cm, the weight on poses within 0.1 diameters and 2 cm (ADD) of the
    truth; rank, the mean share of the belief that lies deeper in it than the truth (0.5 if
    calibrated); coverage_50 and coverage_90, in percent, the images in which that share is at most
    0.5 and 0.9 (50 and 90 if calibrated, less if too sure).
    """

    full_state_update = False
    rows: list[Tensor]
    names = (
        "entropy",
        "effective_particles",
        "spread_m",
        "spread_rad",
        "mass_01d",
        "mass_2cm",
        "rank",
    )

    def __init__(self, models: Sequence[ObjectModel], points: int = 256, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.models = list(models)
        self.points = [thin(model.points, points) for model in models]
        self.add_state("rows", default=[], dist_reduce_fx="cat")

    def update(self, belief: Belief, truth: Tensor, object_id: Tensor | None = None) -> None:
        """Collect beliefs and the truth (B, 4, 4); object_id (B,): index into `models`, the only
        one if None.
        """
        ids = torch.zeros(len(truth), dtype=torch.int64) if object_id is None else object_id
        for index in ids.unique().tolist():
            here = (ids == index).to(truth.device)
            model = self.models[index]
            space = PoseSpace(tuple(model.center.tolist()), model.radius)
            poses, log_w, true = belief.poses[here], belief.log_weights[here], truth[here]
            near = lambda threshold: mass_within(poses, log_w, true, self.points[index], threshold)  # noqa: B023, E731
            values = [
                entropy(log_w),
                1 / log_w.exp().square().sum(1),
                *spread(poses, log_w, space),
                near(0.1 * model.diameter),
                near(0.02),
                rank_of_truth(poses, log_w, true, space),
            ]
            self.rows.append(torch.stack(values, dim=1).double())

    def compute(self) -> dict[str, float]:
        """Return each measure's mean over the images; empty without images."""
        if not len(self.rows):
            return {}
        rows = dim_zero_cat(self.rows)
        out = dict(zip(self.names, rows.mean(0).tolist(), strict=True))
        for percent in (50, 90):
            out[f"coverage_{percent}"] = float(100 * (rows[:, -1] <= percent / 100).double().mean())
        return out
