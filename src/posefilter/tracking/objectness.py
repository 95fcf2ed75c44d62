"""Is the object where a pose puts it? What the frame says of that."""

import torch
from torch import Tensor

from posefilter.confidence.calibration import Assessment
from posefilter.confidence.features import measure_depth
from posefilter.filters.auxiliary import gather_objectness
from posefilter.geometry.camera import project
from posefilter.geometry.pose import transform
from posefilter.models.base import PoseEstimator
from posefilter.types import Batch, Trace

_POINTS = 256  # of the surface, that are looked at
# objectness that is as good as 1: rims and what stands before an object take their share
_FULL = 0.6


def measure_objectness(objectness: Tensor, batch: Batch, pose: Tensor, points: Tensor) -> float:
    """Return the mean objectness of the pixels that a pose's object covers.

    The score of a pose cannot tell this: scores are log-likelihoods up to a constant of the image,
    and of an image without the object the search finds a pose that scores as high.

    Args:
        objectness: (1, 1, h, w) the probability that each cell of the image shows the object.
        batch: The image.
        pose: (4, 4) camera_from_object [m].
        points: (P, 3) surface points of the object [m].

    Returns:
        The mean over the object's points in the frame, in [0, 1]; 0 where none is, or one is behind
        the camera.
    """
    height, width = batch.rgb.shape[-2:]
    camera = transform(pose, points[:: max(1, len(points) // _POINTS)].to(pose))
    if not bool((camera[:, 2] > 0).all()):
        return 0.0
    pixels = project(camera, batch.intrinsics[0])
    size = pixels.new_tensor([width, height])
    inside = ((pixels > -0.5) & (pixels < size - 0.5)).all(1)
    if not bool(inside.any()):
        return 0.0
    h, w = objectness.shape[-2:]
    # cells of whole pixels, the last of which may reach beyond the image
    side = max(-(-height // h), -(-width // w))
    if (-(-height // side), -(-width // side)) == (h, w):
        height, width = h * side, w * side
    found = gather_objectness(objectness, pixels[inside][None], height, width)
    return float(torch.mean(found))


def measure_presence(
    method: PoseEstimator,
    trace: Trace,
    batch: Batch,
    objectness: float,
    margin: Tensor | None = None,
) -> tuple[float, Assessment | None]:
    """Return how probable it is that the object is where an estimate puts it.

    Of a calibrated method it is its calibrated presence. That is fitted to estimates on single
    images; a track's features are of the same kind, but its particles are fewer, and the network
    may have seen a window only. Of another method it is the objectness, as a share of 0.6, lowered
    where the depth sees through more of the surface than it finds there; that is no probability.

    Args:
        method: The object's filter.
        trace: The estimate, with the encoded image.
        batch: The image.
        objectness: As returned by `measure_objectness`.
        margin: (1,) `rotation_margin` of an earlier frame, which is then not measured.

    Returns:
        The presence in [0, 1], and the calibrated probabilities where there are any.
    """
    found = method.assess(trace, batch, margin)
    if found is not None:
        return float(found.presence), found
    free_space = measure_depth(trace.belief.best, batch, method.object_model)["free_space"]
    return min(1.0, objectness / _FULL) * min(1.0, 2 * float(free_space)), None
