"""The loss of heatmaps."""

from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from posefilter.capabilities import Capabilities
from posefilter.geometry.keypoints import draw_gaussians, project_keypoints
from posefilter.types import Batch, ObjectModel, Trace


class Heatmaps:
    """Cross-entropy of each cell against a Gaussian about the keypoint, summed over each map.

    Keypoints behind the camera have an empty map; of those beside the frame it has what reaches
    into it, and hidden ones are drawn as any other. DOPE has the squared error, whose gradient is
    near zero while a new network takes all cells for empty.

    The trace's encoding has `logits` (B, 9, h, w), `keypoints` (9, 3) in the object's frame [m] and
    `stride`, the pixels of a cell.

    Args:
        sigma: Standard deviation of the Gaussian [cells].
    """

    requires: ClassVar[Capabilities] = ("heatmaps",)

    def __init__(self, sigma: float = 1.5) -> None:
        self.sigma = sigma

    def __call__(self, trace: Trace, batch: Batch, object_model: ObjectModel) -> Tensor:
        """Return the loss of each image, (B,)."""
        encoding = trace.encoding
        pixels, ahead = project_keypoints(
            batch.camera_from_object[:, None], encoding.keypoints, batch.intrinsics
        )
        h, w = encoding.logits.shape[-2:]
        target = draw_gaussians(pixels[:, 0], ahead[:, 0], h, w, encoding.stride, self.sigma)
        loss = F.binary_cross_entropy_with_logits(encoding.logits, target, reduction="none")
        entropy = torch.special.entr(target) + torch.special.entr(1 - target)
        return (loss - entropy).sum((2, 3)).mean(1)  # 0 where the maps are right
