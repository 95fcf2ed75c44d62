"""The messages that are read and written, by the package rosbags.

A bag's own definitions of its messages are not used: code would be made of them.
"""

import struct
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from posefilter.data.readers.decode import decode_image
from posefilter.errors import UserError
from posefilter.geometry.lens import read_distortion, undistort
from posefilter.limits import MOST_SIDE

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
DETECTIONS = "vision_msgs/msg/Detection3DArray"

# vision_msgs 4
_VISION = {
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose"
    ),
    "Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id"
    ),
    "Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
}
_MODELS = ("plumb_bob", "rational_polynomial", "equidistant")  # of distortion
# ROS names a mosaic by its first two rows, OpenCV by the middle of the second and third
_BAYER = {
    "bayer_rggb8": cv2.COLOR_BayerBG2RGB,
    "bayer_bggr8": cv2.COLOR_BayerRG2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGR2RGB,
    "bayer_grbg8": cv2.COLOR_BayerGB2RGB,
}
_COLORS: dict[str, tuple[int, int | None]] = {  # channels, and what OpenCV makes RGB of them by
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    **dict.fromkeys(("yuv422", "uyvy"), (2, cv2.COLOR_YUV2RGB_UYVY)),  # the second since Iron
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, cv2.COLOR_YUV2RGB_YUY2)),
    **{name: (1, code) for name, code in _BAYER.items()},
}
_SATURATED = 65535  # what cameras write into 16 bits beyond their range
_PNG = b"\x89PNG\r\n\x1a\n"
_DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}


@cache
def open_types() -> Any:
    """Return the types of messages: those of ROS 2 Humble, and vision_msgs."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _VISION.items():
        types.register(get_types_from_msg(text, f"vision_msgs/msg/{name}"))
    return types


def make_message(name: str, **fields: Any) -> Any:
    """Return a message of a type such as `geometry_msgs/msg/Pose`."""
    return open_types().types[name](**fields)


def decode_color(message: Any, topic: str) -> np.ndarray:
    """Return the color of an Image or a CompressedImage.  -> (H, W, 3) uint8, RGB.

    Raises:
        UserError: It is damaged, or of an encoding that is not known.
    """
    if hasattr(message, "format"):
        return _decode_compressed_color(message, topic)
    encoding = str(message.encoding)
    if encoding not in _COLORS:
        known = ", ".join(_COLORS)
        raise UserError(f"color={topic}: encoding {encoding} is not known; there are {known}")
    channels, code = _COLORS[encoding]
    rows = _read_rows(message, topic, "color", np.dtype("u1"), channels)
    if code is None:
        return rows
    if rows.shape[1] % 2 and channels == 2:
        raise UserError(f"color={topic}: {encoding} of an odd width, {rows.shape[1]}")
    return np.asarray(cv2.cvtColor(rows, code))


def _decode_compressed_color(message: Any, topic: str) -> np.ndarray:
    """Return color (H, W, 3) RGB of the transport `compressed`, whose format is such as `rgb8; jpeg
    compressed bgr8`: what it was, and what was packed; or the name of the packing alone.

    Red and blue of `compressed rgb8`, which old publishers write, are packed the other way round.
    """
    own, _, packed = str(message.format).partition(";")
    own = own.strip()
    if packed and own in _DEPTHS and own != "mono16":
        raise UserError(f"color={topic}: format '{message.format}' is of depth, not of color")
    data, path = bytes(message.data), Path(f"color={topic}")
    if own in _BAYER and packed.split()[-1:] == ["compressed"]:  # the mosaic itself
        return np.asarray(cv2.cvtColor(decode_image(data, path, cv2.IMREAD_GRAYSCALE), _BAYER[own]))
    as_stored = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION  # as depth and camera_info are
    bgr = decode_image(data, path, as_stored)
    swapped = packed.split()[-2:-1] == ["compressed"] and packed.split()[-1].startswith("rgb")
    return bgr if swapped else np.ascontiguousarray(bgr[..., ::-1])


def decode_depth(message: Any, topic: str, units: float = 1000.0) -> np.ndarray:
    """Return the depth of an Image or a CompressedImage.  -> (H, W) float32 [m], 0 where unknown.

    Args:
        message: The message.
        topic: Told in errors.
        units: Units of whole numbers a meter; ROS has millimeters.

    Raises:
        UserError: It is damaged, or of an encoding that is not known.
    """
    if hasattr(message, "format"):
        depth = _decode_compressed_depth(message, topic, units)
    else:
        encoding = str(message.encoding)
        if encoding not in _DEPTHS:
            raise UserError(
                f"depth={topic}: encoding {encoding} is not known; there are 16UC1 (millimeters) "
                f"and 32FC1 (meters)"
            )
        order = ">" if message.is_bigendian else "<"
        rows = _read_rows(message, topic, "depth", np.dtype(order + _DEPTHS[encoding]), 1)[..., 0]
        depth = _drop_saturated(rows).astype(np.float32)
        depth = depth if encoding == "32FC1" else depth * np.float32(1 / units)
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)


def _drop_saturated(rows: np.ndarray) -> np.ndarray:
    return rows if rows.dtype.kind == "f" else np.where(rows == _SATURATED, 0, rows)


def _decode_compressed_depth(message: Any, topic: str, units: float) -> np.ndarray:
    """Return depth (H, W) [m] of the transports `compressedDepth` and `compressed`, both as PNG.

    `compressedDepth` puts 12 bytes before the PNG: a number of the format, and a and b by which it
    keeps depth in meters as whole numbers, a / depth + b.
    """
    encoding, data = str(message.format).split(";")[0].strip(), bytes(message.data)
    start = 0 if data.startswith(_PNG) else 12
    if encoding not in _DEPTHS or data[start : start + len(_PNG)] != _PNG:
        raise UserError(
            f"depth={topic}: format '{message.format}' is not known; there are 16UC1 "
            f"(millimeters) and 32FC1 (meters) as PNG, of compressedDepth"
        )
    picture = decode_image(data[start:], Path(f"depth={topic}"))
    if picture.ndim != 2 or picture.dtype != np.uint16 or (encoding == "32FC1" and not start):
        raise UserError(
            f"depth={topic}: holds {picture.dtype} {picture.shape}, not 16 bits of one channel"
        )
    kept = _drop_saturated(picture).astype(np.float32)
    if encoding != "32FC1":
        return kept * np.float32(1 / units)
    _, a, b = struct.unpack_from("<iff", data)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(kept > 0, np.float32(a) / (kept - np.float32(b)), 0)


def _read_rows(message: Any, topic: str, key: str, kind: np.dtype, channels: int) -> np.ndarray:
    """Return an image's pixels (H, W, channels), without the padding of its rows."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(bytes(message.data), np.uint8)
    needed = width * channels * kind.itemsize
    sized = 0 < height <= MOST_SIDE and 0 < width <= MOST_SIDE
    if not sized or step < needed or len(data) < step * height:
        raise UserError(
            f"{key}={topic}: an image of {width}x{height} pixels has {len(data)} bytes, of rows of "
            f"{step}"
        )
    rows = data[: step * height].reshape(height, step)[:, :needed]
    return np.ascontiguousarray(rows).view(kind).reshape(height, width, channels)


def decode_intrinsics(
    message: Any, size: tuple[int, int], topic: str = "camera_info"
) -> np.ndarray:
    """Return the camera matrix (3, 3) [px] of a CameraInfo: of the rectified image where it has
    one.

    Args:
        message: The CameraInfo; its matrices are of the whole sensor, which a region of interest
            and binning make smaller.
        size: Height and width of the image [px].
        topic: Told in errors.

    Raises:
        UserError: The camera is not calibrated, or is of an image of another size.
    """
    return _read_matrices(message, size, topic)[1]


def _read_matrices(
    message: Any, size: tuple[int, int], topic: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return K of raw images, zeros where it is not told, and the matrix of rectified ones."""
    P = np.asarray(message.p, dtype=np.float64).reshape(3, 4)[:, :3]
    K = np.asarray(message.k, dtype=np.float64).reshape(3, 3)
    if not P[0, 0] > 0 and not K[0, 0] > 0:  # so a driver says it
        raise UserError(f"camera_info={topic}: the camera is not calibrated (K and P are 0)")
    part = _find_part(message, size, topic)
    return part @ K, part @ (P if P[0, 0] > 0 else K)


def _find_part(message: Any, size: tuple[int, int], topic: str) -> np.ndarray:
    """Return what makes the whole sensor's pixels those of an image, (3, 3).

    The principal point is divided by the binning as it is, as in ROS's image_geometry.
    """
    roi = message.roi
    whole = (int(message.height), int(message.width))
    if size == whole:  # also where a driver tells the binning of matrices that are of this size
        return np.eye(3)
    bins = (max(int(message.binning_y), 1), max(int(message.binning_x), 1))
    region = (int(roi.height), int(roi.width))
    sides = region if all(region) else whole  # 0: the whole sensor, or not told
    shown = tuple(side // each for side, each in zip(sides, bins, strict=True))
    if all(sides) and size != shown:
        raise UserError(
            f"camera_info={topic}: is of images of {shown[1]}x{shown[0]} pixels, but the color "
            f"image has {size[1]}x{size[0]}; name the camera's own topic"
        )
    y, x = bins
    return np.array(
        [[1 / x, 0, -int(roi.x_offset) / x], [0, 1 / y, -int(roi.y_offset) / y], [0, 0, 1]]
    )


def rectify(
    rgb: np.ndarray, depth: np.ndarray, message: Any, topic: str = "camera_info"
) -> tuple[np.ndarray, np.ndarray]:
    """Return raw images without the lens distortion that a CameraInfo tells, as of the camera that
    `decode_intrinsics` returns.

    Raises:
        UserError: The camera is not calibrated, is of images of another size or of a stereo pair,
            or has another distortion.
    """
    K, wanted = _read_matrices(message, rgb.shape[:2], topic)
    R = np.asarray(message.r, dtype=np.float64).reshape(3, 3)
    if not K[0, 0] > 0:
        raise UserError(f"camera_info={topic}: has no matrix K of raw images; rectify=false?")
    if R.any() and not np.allclose(R, np.eye(3), atol=1e-6):
        raise UserError(
            f"camera_info={topic}: turns rectified images (R), as of a stereo pair, which is not "
            "supported; have stereo_image_proc rectify them"
        )
    if not is_distorted(message):
        same = np.allclose(K, wanted)
        return (rgb, depth) if same else undistort(rgb, depth, K, np.zeros(4), False, wanted)
    model = str(message.distortion_model)
    if model and model not in _MODELS:
        known = ", ".join(_MODELS)
        raise UserError(f"camera_info={topic}: distortion_model={model} is not one of {known}")
    fisheye = model == "equidistant"
    try:
        numbers = read_distortion(message.d, fisheye)
    except UserError as error:
        raise UserError(f"camera_info={topic}: {error}") from error
    return undistort(rgb, depth, K, numbers, fisheye, wanted)


def is_distorted(message: Any) -> bool:
    """Tell whether a CameraInfo has coefficients of lens distortion."""
    return bool(np.any(np.asarray(message.d, dtype=np.float64) != 0))


def stamp_of(message: Any) -> int:
    """Return the time in a message's header [ns]."""
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)
