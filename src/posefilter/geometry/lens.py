"""Lens distortion, undone: images as a camera of the same place, without it, would take them."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from posefilter.errors import UserError
from posefilter.geometry.camera import check_camera_matrix
from posefilter.limits import FEWEST_KNOWN

_COUNTS = (4, 5, 8, 12, 14)  # of coefficients that OpenCV's model takes
_COUNT_FISHEYE = 4
_LEFT = 0.5  # of the depth, of images without distortion


def undistort(
    rgb: np.ndarray,
    depth: np.ndarray,
    intrinsics: Any,
    distortion: Any,
    fisheye: bool = False,
    new_intrinsics: Any = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return color and depth without the distortion of the lens; what no pixel shows is 0.

    The estimator takes images of a pinhole camera. Those of drivers that rectify, and of datasets,
    are; raw images of a wide lens are not, and a pose in a corner would be off by centimeters.
    Depth is that of the nearest pixel, since a mean of two surfaces is none.

    Args:
        rgb: Color (H, W, 3), uint8 or float32.
        depth: z-depth (H, W), uint16 or float, registered to the color: with its distortion.
        intrinsics: Camera matrix (3, 3) of the raw images [px].
        distortion: Coefficients in the order of OpenCV and ROS: k1, k2, p1, p2, then k3, then k4 to
            k6, and so on, so 4, 5, 8, 12 or 14 (ROS: plumb_bob, rational_polynomial); of a fisheye
            lens k1 to k4 (ROS: equidistant).
        fisheye: Whether they are of a fisheye lens (Kannala and Brandt 2006).
        new_intrinsics: Camera matrix (3, 3) that the returned images shall have, `P[:, :3]` of a
            ROS CameraInfo; None: `intrinsics`.

    Returns:
        Color and depth, of the same shapes and types.

    Raises:
        UserError: There are not as many coefficients, or they are no numbers; or intrinsics are no
            camera matrix; or the shapes differ, or a type cannot be resampled.
    """
    for name, one in (("rgb", rgb), ("depth", depth)):
        if not isinstance(one, np.ndarray):
            raise UserError(f"{name}: expected an array of NumPy, not {type(one).__name__}")
    if rgb.ndim > 3 or depth.ndim != 2:
        raise UserError(
            f"rgb, depth: have shapes {rgb.shape} and {depth.shape}; expected one image (H, W, 3) "
            "and (H, W)"
        )
    height, width = depth.shape
    if rgb.shape[:2] != (height, width):
        raise UserError(f"depth: has shape {depth.shape}, but rgb {rgb.shape}, not (H, W, 3)")
    K, wanted = (
        tuple(check_camera_matrix(one).ravel().tolist())
        for one in (intrinsics, intrinsics if new_intrinsics is None else new_intrinsics)
    )
    maps = _find_maps(K, wanted, read_distortion(distortion, fisheye), fisheye, width, height)
    # masked depth is unknown
    color, z = (np.ascontiguousarray(np.ma.filled(one, 0)) for one in (rgb, depth))
    try:
        return cv2.remap(color, *maps, cv2.INTER_LINEAR), cv2.remap(z, *maps, cv2.INTER_NEAREST)
    except cv2.error as error:
        raise UserError(
            f"rgb, depth: types {color.dtype} and {z.dtype} of {width}x{height} pixels cannot be "
            "resampled; uint8 or float32, and uint16 or float32, can"
        ) from error


def undistort_most(
    rgb: np.ndarray, depth: np.ndarray, intrinsics: Any, distortion: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return color and depth as `undistort` does, where most of the depth is left.

    Raises:
        UserError: Less than half of it is: no lens distorts so much.
    """
    color, z = undistort(rgb, depth, intrinsics, distortion)
    before = int(np.count_nonzero(depth))
    left = np.count_nonzero(z) / max(before, 1)
    if left < _LEFT and before >= FEWEST_KNOWN * depth.size:  # else it is noise
        raise UserError(
            f"distortion={','.join(f'{one:g}' for one in distortion)}: without it, "
            f"{100 * left:.1f} % of the depth is left; are these the lens's coefficients, in this "
            "order?"
        )
    return color, z


def read_distortion(numbers: Any, fisheye: bool = False) -> tuple[float, ...]:
    """Return the coefficients of a lens distortion.

    Raises:
        UserError: There are not as many as a model has, or one is no number.
    """
    counts = (_COUNT_FISHEYE,) if fisheye else _COUNTS
    try:
        array = np.asarray(numbers, dtype=np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise UserError(f"distortion={numbers}: are no numbers") from error
    if len(array) not in counts or not np.isfinite(array).all():
        known = " or ".join(map(str, counts))
        raise UserError(
            f"distortion={array.tolist()}: expected {known} finite coefficients, "
            f"{'k1 to k4' if fisheye else 'k1,k2,p1,p2[,k3[,k4,k5,k6...]]'}"
        )
    return tuple(array.tolist())


@lru_cache(maxsize=4)  # a video's frames have the same
def _find_maps(
    K: Sequence[float],
    wanted: Sequence[float],
    coefficients: Sequence[float],
    fisheye: bool,
    width: int,
    height: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return where each pixel of the new image is in the raw one, (H, W) of x and of y [px]."""
    own, new = (np.reshape(matrix, (3, 3)) for matrix in (K, wanted))
    find = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    maps = find(own, np.array(coefficients), np.eye(3), new, (width, height), cv2.CV_32FC1)
    return maps[0], maps[1]
