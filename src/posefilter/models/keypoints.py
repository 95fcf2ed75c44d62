"""A baseline without a filter: heatmaps of the box's corners, and a pose from their peaks.

As DOPE has it (Tremblay et al. 2018): a network predicts a map for each corner of the object's
bounding box and for its center, the maps' peaks are found, and perspective-n-point (EPnP, Lepetit
et al. 2009) gives the pose. Depth is an input of the network, as for the other methods
(`model.net.depth=false` takes it away), and is not used for the pose.
"""

from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Generator, Tensor

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.geometry.camera import rays
from posefilter.geometry.keypoints import (
    KEYPOINTS,
    box_keypoints,
    find_peaks,
    project_keypoints,
    solve_pnp,
)
from posefilter.geometry.lookup import sample
from posefilter.geometry.pose import pose_about
from posefilter.models.pose_particles import Hypotheses
from posefilter.nets.heatmaps import STRIDE, HeatmapNet
from posefilter.types import Batch, ObjectModel

_LEAST = 0.01  # height of a peak
# of a box's longest side: thinner, EPnP fails on pixels that are off by a third of a pixel
_FLAT = 0.01
_FALLBACK = 1.0  # [m] depth of the center where no pose is found


class KeypointEncoding(NamedTuple):
    """Encoded images."""

    logits: Tensor  # (B, 9, h, w)
    keypoints: Tensor  # (9, 3) in the object's frame [m]
    intrinsics: Tensor  # (B, 3, 3) [px]
    measured_depth: Tensor  # (B, H, W) z-depth [m]; 0 unknown
    stride: int = STRIDE

    @property
    def maps(self) -> Tensor:
        """The belief that each cell is at the keypoint, (B, 9, h, w) in [0, 1]."""
        return torch.sigmoid(self.logits)


class Keypoints(Hypotheses):
    """Heatmaps and perspective-n-point.

    The first hypothesis is OpenCV's RANSAC over the highest peaks of all maps. Each other one is a
    fit to some keypoints, drawn by the height of their highest peak, at peaks drawn by height.

    Args:
        net: The network.
        peaks: Peaks of a map that hypotheses are drawn from.
        subset: Keypoints of a hypothesis.
        inlier_px: Distance of an inlier of OpenCV's RANSAC [px].
        **base: Arguments of `PoseEstimator`.
    """

    provides: ClassVar[Capabilities] = ("heatmaps", "depth", "pose", "pose_space", "propose_poses")
    test_only_settings = ("filter", "train_rollout", "peaks", "subset", "inlier_px")

    def __init__(
        self,
        net: HeatmapNet,
        peaks: int = 3,
        subset: int = 6,
        inlier_px: float = 4.0,
        **base: Any,
    ) -> None:
        super().__init__(**base)
        self.net, self.peaks, self.subset, self.inlier_px = net, peaks, subset, inlier_px

    def set_object(self, object_model: ObjectModel) -> None:
        """Set the object.

        Raises:
            UserError: It is flat: the corners of its box lie in a plane, from which EPnP finds no
                pose.
        """
        extent = object_model.hull.amax(0) - object_model.hull.amin(0)
        if float(extent.min()) < _FLAT * float(extent.max()):
            raise UserError(
                f"model=keypoints: {object_model.name} is flat, so that the corners of its box are "
                "nearly in a plane, from which EPnP finds no pose; choose another model"
            )
        super().set_object(object_model)

    def encode(self, batch: Batch) -> KeypointEncoding:
        """Run the network."""
        logits = self.net(batch.rgb, batch.depth, batch.intrinsics)
        keypoints = box_keypoints(self.object_model.hull).to(logits)
        return KeypointEncoding(logits, keypoints, batch.intrinsics, batch.depth[:, 0])

    def propose_poses(
        self, encoding: KeypointEncoding, particles: int, generator: Generator
    ) -> Tensor:
        """Solve for poses that put keypoints at peaks.

        Where none is found, the pose is that of an unturned object 1 m deep, behind the highest
        peak of its center: its score is low.  -> camera_from_object (B, particles, 4, 4) [m].
        """
        pixels, heights = find_peaks(encoding.maps.detach(), self.peaks, encoding.stride)
        drawn, rows = self.draw_subsets(heights, particles, generator)
        lost = self.fall_back(encoding, pixels[:, -1, 0])
        points = encoding.keypoints.double().cpu().numpy()
        images = zip(
            *(x.double().cpu().numpy() for x in (pixels, heights, encoding.intrinsics, lost)),
            drawn.cpu().numpy(),
            rows.cpu().numpy(),
            strict=True,
        )
        poses = [self.solve(points, *image) for image in images]
        return torch.from_numpy(np.stack(poses)).to(encoding.logits)

    def draw_subsets(
        self, heights: Tensor, count: int, generator: Generator
    ) -> tuple[Tensor, Tensor]:
        """Draw keypoints for hypotheses, and a peak of each keypoint's map.

        Heights (B, 9, peaks) -> keypoints (B, count, subset), and peaks (B, count, 9), int64.
        """
        B = len(heights)
        chances = heights[..., 0].clamp_min(1e-4)[:, None].expand(-1, count, -1).flatten(0, 1)
        chosen = torch.multinomial(chances, self.subset, generator=generator)
        of_each = heights.clamp_min(1e-6).flatten(0, 1)
        peaks = torch.multinomial(of_each, count, replacement=True, generator=generator)
        return chosen.unflatten(0, (B, count)), peaks.unflatten(0, (B, KEYPOINTS)).transpose(1, 2)

    def solve(
        self,
        points: np.ndarray,
        pixels: np.ndarray,
        heights: np.ndarray,
        K: np.ndarray,
        default: np.ndarray,
        chosen: np.ndarray,
        peaks: np.ndarray,
    ) -> np.ndarray:
        """Return one image's hypotheses (count, 4, 4); `default` (4, 4) where there is none."""
        sure = heights[:, 0] > _LEAST
        poses = [solve_pnp(points[sure], pixels[sure, 0], K, self.inlier_px)]
        for few, row in zip(chosen[1:], peaks[1:], strict=True):
            poses.append(solve_pnp(points[few], pixels[few, row[few]], K))
        return np.stack([default if pose is None else pose for pose in poses])

    def fall_back(self, encoding: KeypointEncoding, pixels: Tensor) -> Tensor:
        """Return unturned poses 1 m deep whose centers are at pixels.  (B, 2) -> (B, 4, 4)."""
        place = rays(pixels[:, None], encoding.intrinsics)[:, 0] * _FALLBACK
        turn = torch.eye(3, device=place.device).expand(len(place), 3, 3)
        return pose_about(turn, place, encoding.keypoints[-1])

    def score(self, encoding: KeypointEncoding, poses: Tensor) -> Tensor:
        """Return the mean belief at the places where a pose puts the keypoints.

        (B, N, 4, 4) [m] -> (B, N) in [0, 1]; a keypoint out of the frame counts as 0.
        """
        pixels, ahead = project_keypoints(poses, encoding.keypoints, encoding.intrinsics)
        maps, places = encoding.maps.flatten(0, 1)[:, None], pixels.transpose(1, 2).flatten(0, 1)
        belief = sample(maps, places, encoding.stride)[..., 0].unflatten(0, (len(poses), KEYPOINTS))
        return (belief.transpose(1, 2) * ahead).mean(-1)
