"""How well each part of an object is found: a hammer's head and its handle, say.

The paper's first figure of merit is a bounding-box IoU by part (section 4.1; Pavlasek et al. 2020).
"""

from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric

from posefilter.geometry.boxes import box_iou, box_of_pose
from posefilter.geometry.camera import back_project
from posefilter.geometry.pose import invert, transform
from posefilter.types import Batch, ObjectModel

_REACH = 0.1  # diameters: a pixel that is farther from every part belongs to none
_PIXELS = 400  # of an image, at most


def label_pixels(points: Tensor, pose: Tensor, object_model: ObjectModel) -> Tensor:
    """Return the part that is nearest to each measured point.

    Args:
        points: (M, 3) in the camera's frame [m].
        pose: (4, 4) camera_from_object [m].
        object_model: The object, with its parts.

    Returns:
        (M,) index of the part, -1 where all are farther than a tenth of the diameter.
    """
    local, parts = transform(invert(pose), points), (object_model.parts or {}).values()
    distance = [torch.cdist(local, part.to(local)).amin(1) for part in parts]
    nearest = torch.stack(distance, dim=1).min(1)
    return torch.where(nearest.values < _REACH * object_model.diameter, nearest.indices, -1)


class PartIoU(Metric):
    """IoU of each part at the estimated pose and at the true one, of boxes and of masks.

    Boxes enclose the whole part, hidden pixels too, as far as it is in the frame. Masks are of the
    object's visible pixels with depth: each belongs to the part that is nearest at a pose.

    Args:
        object_model: An object with parts.
        **kwargs: Arguments of torchmetrics.Metric.
    """

    full_state_update = False
    totals: Tensor  # (2, parts) sums of the boxes' and of the masks' IoU
    counts: Tensor  # (2, parts) how many each sum has

    def __init__(self, object_model: ObjectModel, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.object_model, self.parts = object_model, dict(object_model.parts or {})
        shape = (2, len(self.parts))
        self.add_state("totals", torch.zeros(shape, dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("counts", torch.zeros(shape, dtype=torch.int64), dist_reduce_fx="sum")

    def update(self, poses: Tensor, batch: Batch) -> None:
        """Accumulate a batch.

        Args:
            poses: (B, 4, 4) estimates, camera_from_object [m]; one that is not finite is a miss.
            batch: Its images, with the true poses.
        """
        height, width = batch.rgb.shape[-2:]
        truth, K = batch.camera_from_object, batch.intrinsics
        finite = poses.isfinite().flatten(1).all(1)
        placed = torch.where(finite[:, None, None], poses, truth)
        for k, points in enumerate(self.parts.values()):
            target = box_of_pose(truth, points, K, height, width)
            box = box_of_pose(placed, points, K, height, width) * finite[:, None]
            in_frame = (target[:, 2:] > target[:, :2]).all(1)
            self.totals[0, k] += box_iou(box, target)[in_frame].double().sum()
            self.counts[0, k] += in_frame.sum()
        for b in range(len(truth)):
            self._add_masks(placed[b], bool(finite[b]), batch, b)

    def _add_masks(self, pose: Tensor, finite: bool, batch: Batch, b: int) -> None:
        at = (batch.mask[b, 0] & (batch.depth[b, 0] > 0)).nonzero()
        if len(at) == 0:
            return
        at = at[:: max(1, -(-len(at) // _PIXELS))]
        z = batch.depth[b, 0][at[:, 0], at[:, 1]]
        points = back_project(at.flip(1)[None].to(z), z[None], batch.intrinsics[b : b + 1])[0]
        labels = label_pixels(points, batch.camera_from_object[b], self.object_model)
        guesses = torch.full_like(labels, -2)
        if finite:
            guesses = label_pixels(points, pose, self.object_model)
        for k in range(len(self.parts)):
            true, estimated = labels == k, guesses == k
            if bool(true.any()):
                self.totals[1, k] += (true & estimated).sum() / (true | estimated).sum()
                self.counts[1, k] += 1

    def compute(self) -> dict[str, Any]:
        """Return {"box_iou", "mask_iou", "by_part": {name: {"box_iou", "mask_iou"}}}; the first two
        are means over the parts, NaN where a part was in no image.
        """
        each = (self.totals / self.counts).tolist()
        names = ("box_iou", "mask_iou")
        by_part = {
            part: {name: each[i][k] for i, name in enumerate(names)}
            for k, part in enumerate(self.parts)
        }
        means = (self.totals / self.counts).mean(1).tolist()
        return {**dict(zip(names, means, strict=True)), "by_part": by_part}
