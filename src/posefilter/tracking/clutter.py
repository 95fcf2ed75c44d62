"""Is the object still there? The estimate's likelihood against that of clutter."""

import math

import torch
from torch import Generator, Tensor

from posefilter.filters.initialize import draw_from_depth
from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Scene, ScoresPoses
from posefilter.types import Batch


def measure_odds(
    scorer: ScoresPoses,
    scene: Scene,
    batch: Batch,
    pose: Tensor,
    space: PoseSpace,
    generator: Generator,
    decoys: int = 16,
    pixels: int = 128,
    sigma: float = 0.008,
) -> float:
    """Return the log odds of a pose against poses at random surfaces of the same image.

    Scores are log-likelihoods up to a constant of the image, so that only their differences tell.
    The clutter level is the log of the decoys' mean likelihood. Decoys have uniform rotations, and
    their centers lie behind measured points.

    Args:
        scorer: Scores poses.
        scene: The encoded image.
        batch: The image, as it was encoded.
        pose: (4, 4) camera_from_object [m].
        space: The space of poses.
        generator: Source of randomness.
        decoys: Number of random poses.
        pixels: Image points that each is scored from.
        sigma: Noise level [m].

    Returns:
        Log odds [nat]; above 0 where the pose explains the image better than clutter does.
    """
    random = draw_from_depth(batch.depth, batch.intrinsics, space, decoys, generator)
    poses = torch.cat([pose[None, None], random], dim=1)
    scores = scorer.score_poses(scene, poses, sigma, generator, pixels)[0]
    return float(scores[0] - scores[1:].logsumexp(0) + math.log(decoys))
