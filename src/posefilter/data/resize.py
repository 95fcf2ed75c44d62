"""Resize a sample, so that camera, color, depth and mask still agree to a fraction of a pixel."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch

from posefilter.data.frames import Sample
from posefilter.errors import UserError
from posefilter.geometry.camera import resize_intrinsics

_MOST_PIXELS = 1 << 22  # that an image is enlarged to
SMOOTH = 0.02  # neighboring depths within this share of each other lie on one surface


def network_size(
    height: int, width: int, image_width: int | None, image_height: int | None
) -> tuple[int, int]:
    """Return the (height, width) to resize an image to; a missing side keeps the aspect, none keeps
    the size.
    """
    if image_width is None and image_height is None:
        return height, width
    if image_width is None:
        image_width = round(width * float(image_height or 0) / height)
    if image_height is None:
        image_height = round(height * image_width / width)
    if min(image_width, image_height) < 8:
        raise UserError(
            f"image size {image_width}x{image_height}: at least 8 pixels a side (data.image_width)"
        )
    if image_width * image_height > max(_MOST_PIXELS, height * width):
        raise UserError(
            f"image: {width}x{height} would be enlarged to {image_width}x{image_height} pixels "
            f"(data.image_width), which are too many; crop it if it is long and narrow"
        )
    if abs(image_width / width - image_height / height) > 0.02 * image_width / width:
        raise UserError(
            f"image size {image_width}x{image_height} would stretch {width}x{height}: give "
            f"data.image_width alone"
        )
    return image_height, image_width


def resize(sample: Sample, height: int, width: int) -> Sample:
    """Return the sample at another size: color averaged, mask by majority, depth interpolated
    within surfaces only.
    """
    before = sample.mask.shape
    if before == (height, width):
        return sample
    K = torch.from_numpy(sample.intrinsics.astype(np.float64))
    K = resize_intrinsics(K, width / before[1], height / before[0])
    return dataclasses.replace(
        sample,
        rgb=resize_image(sample.rgb, height, width),
        depth=resize_depth(sample.depth, height, width),
        mask=resize_mask(sample.mask, height, width),
        intrinsics=K.numpy().astype(np.float32),
    )


def resize_image(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return an image at another size: averaged where it shrinks, else interpolated."""
    shrinks = height <= image.shape[0] and width <= image.shape[1]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return cv2.resize(image, (width, height), interpolation=how)


def resize_mask(mask: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return the pixels of which the mask covers more than half.  -> (height, width) bool.

    Ties are decided as on a chess board: the nearest old pixel would shift masks by a sixth of a
    pixel at half the size.
    """
    share = resize_image(mask.astype(np.float32), height, width)
    even = (np.arange(height)[:, None] + np.arange(width)) % 2 == 0
    return (share > 0.5 + 1e-4) | ((share > 0.5 - 1e-4) & even)


def resize_depth(depth: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return depth read at the new pixels' centers: between known neighbors on one surface, else
    the nearest pixel.

    Taking the nearest everywhere would shift surfaces by up to half an old pixel, the same way all
    over the image; interpolating everywhere would invent surfaces between near and far.  (H, W) [m]
    -> (height, width) [m].
    """
    if depth.shape == (2 * height, 2 * width):  # the same corners, without an index
        four = [depth[i::2, j::2] for i in (0, 1) for j in (0, 1)]
        return _blend(four, np.float32(0.5), np.float32(0.5))
    (top, fy), (left, fx) = map(find_neighbors, depth.shape, (height, width))
    bottom, right = (
        np.minimum(low + 1, old - 1) for low, old in zip((top, left), depth.shape, strict=True)
    )
    four = [depth[rows][:, columns] for rows in (top, bottom) for columns in (left, right)]
    return _blend(four, fx[None, :], fy[:, None])


def find_neighbors(old: int, new: int) -> tuple[np.ndarray, np.ndarray]:
    """Return where new pixels' centers lie among the old: the pixel before, and how far beyond it.

    -> (new,) int64, (new,) float32 in [0, 1].
    """
    at = np.clip((np.arange(new) + 0.5) * old / new - 0.5, 0, old - 1)
    low = np.minimum(at.astype(np.int64), max(old - 2, 0))
    return low, (at - low).astype(np.float32)


def _blend(four: Sequence[np.ndarray], fx: Any, fy: Any) -> np.ndarray:
    """Return depth between four neighbors, above left to below right, at fractions of a pixel."""
    a, b, c, d = four
    low = np.minimum(np.minimum(a, b), np.minimum(c, d))
    high = np.maximum(np.maximum(a, b), np.maximum(c, d))
    between = (a * (1 - fx) + b * fx) * (1 - fy) + (c * (1 - fx) + d * fx) * fy
    nearest = np.where(fy <= 0.5, np.where(fx <= 0.5, a, b), np.where(fx <= 0.5, c, d))
    return np.where((low > 0) & (high - low <= SMOOTH * low), between, nearest).astype(np.float32)
