"""A baseline without a filter: dense object coordinates, and the best rigid fit to them.

As NOCS has it (Wang et al. 2019): a network predicts which point of the object each cell shows,
depth gives the cell's point in the camera, and RANSAC finds the pose that most of them agree with.
The network and its loss are those of pose_pf's proposals; NOCS itself classifies normalized
coordinates of a category in bins, and fits a scale as well, which is known here.
"""

from typing import Any, ClassVar, NamedTuple

import torch
from torch import Generator, Tensor

from posefilter.capabilities import Capabilities
from posefilter.geometry.ransac import agreement, draw_minimal_fits, refit_to_inliers, weigh_inliers
from posefilter.models.pose_particles import Hypotheses, require_depth
from posefilter.nets.coordinates import Cells, Coordinates
from posefilter.nets.pose_votes import measure_cells
from posefilter.nets.proposals import ObjectCoordinateNet
from posefilter.types import Batch


class DenseEncoding(NamedTuple):
    """Encoded images."""

    coordinates: Coordinates
    cells: Cells
    mean_radius: Tensor  # () the fragments' mean radius, in radii of the object
    source: Tensor  # (B, n, 3) predicted object points of the likeliest cells [m]
    target: Tensor  # (B, n, 3) their measured camera points [m]
    weights: Tensor  # (B, n) their probability of the object, 0 where no depth is known
    measured_depth: Tensor  # (B, H, W) z-depth [m]; 0 unknown
    intrinsics: Tensor  # (B, 3, 3) [px]

    @property
    def objectness(self) -> Tensor:
        """The probability that each cell shows the object, (B, 1, h, w)."""
        return torch.sigmoid(self.coordinates.logit)[:, None]


class DenseCoordinates(Hypotheses):
    """Dense object coordinates and RANSAC.

    Args:
        proposals: The network.
        cells: Most cells of an image that poses are fitted to, the likeliest ones.
        inlier: Distance below which a correspondence agrees with a pose, in diameters.
        refits: How often a hypothesis is fitted to its inliers.
        **base: Arguments of `PoseEstimator`.
    """

    provides: ClassVar[Capabilities] = (
        "correspondences",
        "depth",
        "pose",
        "pose_space",
        "propose_poses",
    )
    test_only_settings = ("filter", "train_rollout", "cells", "inlier", "refits")

    def __init__(
        self,
        proposals: ObjectCoordinateNet,
        cells: int = 300,
        inlier: float = 0.1,
        refits: int = 2,
        **base: Any,
    ) -> None:
        super().__init__(**base)
        self.proposals = proposals
        self.cells, self.inlier, self.refits = cells, inlier, refits

    def encode(self, batch: Batch) -> DenseEncoding:
        """Run the network, and pair the likeliest cells' object points with what was measured."""
        coordinates = self.proposals(batch.rgb, batch.depth, batch.intrinsics)
        cells = measure_cells(batch.depth, batch.intrinsics)
        weights = (torch.sigmoid(coordinates.logit) * cells.valid).flatten(1).detach()
        weights, index = weights.topk(min(self.cells, weights.shape[1]), dim=1)
        rows = index[..., None].expand(-1, -1, 3)
        source = coordinates.coordinate.detach().flatten(1, 2).gather(1, rows)
        source = source * self.object_model.radius + self.object_model.center.to(source)
        target = cells.point.flatten(1, 2).gather(1, rows)
        depth = batch.depth[:, 0]
        paired = (self.proposals.reach, source, target, weights)
        return DenseEncoding(coordinates, cells, *paired, depth, batch.intrinsics)

    def propose_poses(
        self, encoding: DenseEncoding, particles: int, generator: Generator
    ) -> Tensor:
        """Fit poses to three correspondences each, and then to those that agree with them.

        Returns:
            camera_from_object (B, particles, 4, 4) [m].

        Raises:
            UserError: An image has no depth.
        """
        require_depth(encoding.cells.valid)
        pairs = (encoding.source, encoding.target, encoding.weights)
        poses = draw_minimal_fits(*pairs, particles, generator)
        return refit_to_inliers(poses, *pairs, self.tolerance, self.refits)

    def score(self, encoding: DenseEncoding, poses: Tensor) -> Tensor:
        """Return each pose's share of inliers, cells weighted by their probability of the object.

        (B, N, 4, 4) [m] -> (B, N) in [0, 1).
        """
        inside = agreement(poses, encoding.source, encoding.target, self.tolerance)
        return weigh_inliers(inside, encoding.weights)

    @property
    def tolerance(self) -> float:
        """The distance of an inlier [m]."""
        return self.inlier * self.object_model.diameter
