"""Refuse what a camera cannot have seen: intrinsics, poses, depth and labels that cannot be."""

import math
from pathlib import Path

import numpy as np

from posefilter.data.frames import Implausible, Sample
from posefilter.errors import BadData
from posefilter.geometry.camera import find_matrix_flaw

FARTHEST = 100.0  # [m] of an object, and of the median of what a depth image holds
_NEAREST = 0.01  # [m] of that median
_FOCAL = (0.1, 100.0)  # focal lengths, in widths of the image: 157 to 0.6 degrees of view
_ASKEW = 1.5  # focal lengths between the axis and an image's middle: 56 degrees
_SQUARE = 2.0  # the focal lengths of one camera differ by this factor at most
_UNITS = (1e-2, 1e7)  # depth image units a meter


def check_camera(K: np.ndarray, path: Path) -> None:
    """Raise BadData for finite intrinsics K (3, 3) [px] of a file that are no pinhole camera's."""
    if flaw := find_matrix_flaw(K):
        raise BadData(path, "intrinsics are no camera matrix", flaw)


def find_focal_flaw(K: np.ndarray, width: int) -> str:
    """Return why focal lengths are not those of a camera with images so wide [px], "" where they
    may be.
    """
    fx, fy = float(K[0, 0]), float(K[1, 1])
    low, high = _FOCAL[0] * width, _FOCAL[1] * width
    if low <= min(fx, fy) and max(fx, fy) <= high and 1 / _SQUARE <= fx / fy <= _SQUARE:
        return ""
    return f"fx {fx:g}, fy {fy:g} px for an image {width} px wide"


def find_center_flaw(K: np.ndarray, width: int, height: int) -> str:
    """Return why a principal point cannot be right for images of a size [px], "" where it may be.

    That of a part of an image may lie outside of it, as far as a camera sees.
    """
    cx, cy = float(K[0, 2]), float(K[1, 2])
    at = f"({cx:g}, {cy:g}) of {width}x{height}"
    off_x, off_y = abs(cx - width / 2), abs(cy - height / 2)
    if off_x > max(width, _ASKEW * K[0, 0]) or off_y > max(height, _ASKEW * K[1, 1]):
        return f"{at}; another resolution's, or swapped with fx?"
    if 0 <= cx <= 1 and 0 <= cy <= 1:
        return f"{at}; left out, or in units of the image's size?"
    return ""


def check_units(units: float, path: Path, key: str) -> None:
    """Refuse a depth scale that no camera has.  units: of the depth image, a meter.

    Raises:
        BadData: It is not a positive number, or too small or large.
    """
    if units <= 0:
        raise BadData(path, "depth scale is not a positive number", f"{key} = {units:g}")
    if not _UNITS[0] <= units <= _UNITS[1]:  # NaN too
        raise BadData(path, "depth scale is not plausible", f"{key}: {units:g} units a meter")


def narrow(matrix: np.ndarray) -> np.ndarray:
    """Return a matrix as float32; a number that is too large becomes infinite, without a warning:
    `check_sample` refuses it.
    """
    with np.errstate(over="ignore"):
        return matrix.astype(np.float32)


def check_sample(sample: Sample, camera_from_native: np.ndarray, files: tuple[Path, ...]) -> Sample:
    """Return a sample as it is, where a camera can have seen it.

    Args:
        sample: What was read; its intrinsics have passed `check_camera`.
        camera_from_native: Pose of the dataset's own object frame (4, 4) [m].
        files: Where intrinsics, pose, depth and label are from.

    Raises:
        BadData: Depth is unknown everywhere, or the label covers the whole image.
        Implausible: Anything else cannot be; it carries the sample.
    """
    camera, truth, depth, label = files
    known = sample.depth[sample.depth > 0]
    if len(known) == 0:
        raise BadData(depth, "depth is unknown everywhere", "every pixel is 0 or saturated")
    if sample.mask.all():
        raise BadData(label, "the label covers the whole image")
    K, (height, width) = sample.intrinsics, sample.mask.shape
    if flaw := find_focal_flaw(K, width):
        raise Implausible(camera, "focal lengths are not plausible", flaw, sample)
    if flaw := find_center_flaw(K, width, height):
        raise Implausible(camera, "principal point is not plausible", flaw, sample)
    z = float(camera_from_native[2, 3])
    if not (z > 0 and math.hypot(*camera_from_native[:3, 3]) <= FARTHEST):
        where = "behind the camera" if z <= 0 else f"{z:.3g} m away; wrong unit?"
        raise Implausible(truth, "the object cannot be seen where its pose is", where, sample)
    middle = float(np.median(known))
    if not _NEAREST <= middle <= FARTHEST:
        found = f"median {middle:.3g} m; wrong depth scale?"
        raise Implausible(depth, "depth is not plausible", found, sample)
    return sample
