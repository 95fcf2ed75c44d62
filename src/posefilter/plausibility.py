"""Whether an estimate can be right at all: told in words, beside the estimate."""

import numpy as np

from posefilter.types import ObjectModel

_SMALLEST = 16.0  # [px] the diameter, below which nothing on an object can be told apart
_LARGEST = 3.0  # times the image's longer side
_FEWEST = 0.05  # of the pixels have depth
_NEAREST = 0.2  # [m] the median depth; few depth cameras measure nearer
_FARTHEST = 6.0  # [m] likewise; beyond, most measure little, and objects for a hand are some pixels
_NEAR = 0.06  # of the image's size, likewise: nearer ones are those of the whole image
_OFF = 0.24  # of the image's size: principal points farther from its middle are those of a part
_SCALE = "is the depth in the right units (depth_scale)?"


def find_warnings(
    pose: np.ndarray,
    object_model: ObjectModel,
    depth: np.ndarray,
    intrinsics: np.ndarray,
    scale_ratio: float | None = None,
) -> tuple[str, ...]:
    """Return what makes an estimate implausible, one sentence each: first what makes the inputs
    so, see `find_input_warnings`.

    A wrong depth scale moves the answer with it, and its score does not fall: only the object's
    size tells, as a whole and between its points (`confidence.scale_ratio`).

    Args:
        pose: The estimate (4, 4), camera_from_object [m].
        object_model: The object.
        depth: Measured z-depth (H, W) [m], 0 where unknown, at the network's resolution.
        intrinsics: Its camera matrix (3, 3) [px].
        scale_ratio: How large the object appears, relative to its mesh, where that contradicts
            the inputs.
    """
    height, width = depth.shape
    x, y, z = (pose[:3, :3] @ object_model.center.double().numpy() + pose[:3, 3]).tolist()
    found = [*find_input_warnings(depth, intrinsics, scale_ratio)]
    if z <= 0:
        return (*found, "the object would be behind the camera")
    focal = float(np.sqrt(intrinsics[0, 0] * intrinsics[1, 1]))
    pixels = object_model.diameter * focal / z
    if pixels < _SMALLEST:
        found.append(
            f"at {z:.2f} m the object would be {pixels:.0f} pixels large, too small to be told "
            f"apart: {_SCALE}"
        )
    elif pixels > _LARGEST * max(height, width):
        found.append(f"at {z:.2f} m the object would be far larger than the image: {_SCALE}")
    u = intrinsics[0, 0] * x / z + intrinsics[0, 2]
    v = intrinsics[1, 1] * y / z + intrinsics[1, 2]
    if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
        found.append(
            "the object's center would be outside of the image: are the intrinsics and the depth's "
            "units (depth_scale) right?"
        )
    return tuple(found)


def find_input_warnings(
    depth: np.ndarray, intrinsics: np.ndarray, scale_ratio: float | None = None
) -> tuple[str, ...]:
    """Return what makes the inputs implausible, whatever the estimate is; arguments as of
    `find_warnings`.
    """
    height, width = depth.shape
    found = list[str]()
    known = float((depth > 0).mean())
    if known < _FEWEST:
        found.append(f"only {100 * known:.1f} % of the pixels have depth")
    some = depth[::4, ::4]
    median = float(np.median(some[some > 0])) if (some > 0).any() else np.inf
    if median < _NEAREST or _FARTHEST < median < np.inf:
        where = "nearer" if median < _NEAREST else "farther"
        found.append(
            f"the median depth is {median:.2g} m, {where} than most depth cameras measure: {_SCALE}"
        )
    off = np.abs(intrinsics[:2, 2] / (width, height) - 0.5)
    from_swapped = np.abs(intrinsics[:2, 2] - 0.5 * np.array([height, width])) / (width, height)
    if from_swapped.max() < _NEAR < off.min():
        found.append(
            "the intrinsics' principal point is the middle of the image with its sides swapped: "
            "are cx and cy swapped, or is the image turned?"
        )
    elif off.max() > _OFF:
        found.append(
            f"the intrinsics' principal point is far from the middle of the image ({off.max():.0%} "
            "of its size): that is right for a part of an image alone"
        )
    if scale_ratio is not None:
        found.append(
            f"the object appears {scale_ratio:.2f} times as large as its mesh: are the depth's "
            "units (depth_scale), the intrinsics and the mesh's units right?"
        )
    return tuple(found)
