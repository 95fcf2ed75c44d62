"""Images as a user has them, checked and made into what a method takes."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from posefilter.data.readers.plausible import find_center_flaw, find_focal_flaw
from posefilter.data.resize import network_size, resize_depth, resize_image
from posefilter.errors import UserError
from posefilter.geometry.camera import find_matrix_flaw, resize_intrinsics
from posefilter.limits import FEWEST_KNOWN, MOST_SIDE
from posefilter.types import Batch

_INSTEAD = {  # of shapes of intrinsics that users have
    (3, 4): "of a projection matrix P of rectified images give P[:, :3]",
    (9,): "give it as K.reshape(3, 3)",
    (12,): "of a projection matrix P of rectified images give P.reshape(3, 4)[:, :3]",
    (4,): "of fx, fy, cx, cy give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]",
}
BEYOND = 100.0  # [m] no depth camera measures
_FEWEST = 0.02  # share of the pixels with depth
_NEAREST, _FARTHEST = 0.05, 30.0  # [m] between which the median depth of an image lies


class Images(NamedTuple):
    """B photographs of one size, on the processor."""

    rgb: np.ndarray  # (B, H, W, 3) uint8, or float32 in [0, 1]
    depth: np.ndarray  # (B, H, W) float32 z-depth [m], 0 where unknown
    intrinsics: np.ndarray  # (B, 3, 3) float64 [px]


def check_images(rgb: Any, depth: Any, intrinsics: Any, empty: bool = False) -> tuple[Images, bool]:
    """Return a user's images in one form, and whether they came as a batch.

    Args:
        rgb: Color (H, W, 3) or (3, H, W), or a batch of them, RGB: uint8, or float in [0, 1].
        depth: z-depth (H, W), or (B, H, W), in meters, as float; 0, NaN or infinity where unknown.
        intrinsics: Camera matrix (3, 3), or (B, 3, 3), [px] of these images.
        empty: Whether an image may have no depth at all.

    Returns:
        The images, and True where `rgb` has a batch's leading dimension.

    Raises:
        UserError: A shape, type or value is not as it should be.
    """
    color = _as_channels_last(rgb)
    z, K = as_array(depth, "depth"), as_array(intrinsics, "intrinsics")
    batched = color.ndim == 4
    color, z = (value if batched else value[None] for value in (color, z))
    if z.ndim == 4 and 1 in (z.shape[1], z.shape[3]):  # (B, 1, H, W), as torch has it, or last
        z = z[:, 0] if z.shape[1] == 1 else z[..., 0]
    if z.shape != color.shape[:3]:
        raise UserError(
            f"depth: has shape {z.shape[1 - batched :]}, but rgb {color.shape[1 - batched : 3]}"
        )
    if not len(z):
        raise UserError("rgb: is a batch of no images")
    if max(z.shape[1:]) > MOST_SIDE or not all(z.shape):
        raise UserError(
            f"rgb: has {z.shape[2]}x{z.shape[1]} pixels; each side must be 1 to {MOST_SIDE}"
        )
    K = check_intrinsics(K, len(z), (z.shape[1], z.shape[2]))
    return Images(_check_color(color), _check_depth(z, empty), K), batched


def to_picture(rgb: Any) -> np.ndarray:
    """Return one color image, in any form that `check_images` takes, as (H, W, 3) uint8.

    Raises:
        UserError: It is a batch, or a shape, type or value is not as it should be.
    """
    color = _as_channels_last(rgb)
    if color.ndim != 3:
        raise UserError(f"rgb: has shape {color.shape}; expected one image (H, W, 3)")
    color = _check_color(color)
    return color if color.dtype == np.uint8 else (255 * color).round().astype(np.uint8)


def to_camera(intrinsics: Any) -> np.ndarray:
    """Return one camera matrix, an array or tensor, as float64 (3, 3) [px].

    Raises:
        UserError: It is none.
    """
    return check_intrinsics(as_array(intrinsics, "intrinsics"), 1)[0]


def to_pose(pose: Any) -> np.ndarray:
    """Return one pose, an array or tensor, as float64 (4, 4) [m].

    Raises:
        UserError: It is none.
    """
    out = as_array(pose, "pose")
    if out.shape != (4, 4) or out.dtype.kind not in "fiu":
        raise UserError(
            f"pose: has shape {out.shape} and type {out.dtype}; "
            "expected camera_from_object (4, 4) [m]"
        )
    return out.astype(np.float64)


def make_batch(images: Images, image_width: int | None, image_height: int | None) -> Batch:
    """Return images resized as training images were; what is not known of them is empty.

    Args:
        images: The images.
        image_width: Width that the method was trained on [px]; None: it follows from the height.
        image_height: Its height [px], likewise; both None: images stay as they are.
    """
    before = images.depth.shape[1:]
    return make_sized_batch(images, *network_size(before[0], before[1], image_width, image_height))


def make_sized_batch(images: Images, height: int, width: int) -> Batch:
    """Return images resized to a size [px], as `make_batch` does."""
    before = images.depth.shape[1:]
    rgb, depth, K = list(images.rgb), list(images.depth), torch.from_numpy(images.intrinsics)
    if (height, width) != before:
        rgb = [resize_image(one, height, width) for one in rgb]
        depth = [resize_depth(one, height, width) for one in depth]
        K = resize_intrinsics(K, width / before[1], height / before[0])
    color = torch.from_numpy(np.ascontiguousarray(np.stack(rgb).transpose(0, 3, 1, 2)))
    color = color.float() / 255 if color.dtype == torch.uint8 else color
    z = torch.from_numpy(np.stack(depth)).float()[:, None]
    return make_unlabeled(color, z, K.float())


def make_unlabeled(color: torch.Tensor, z: torch.Tensor, K: torch.Tensor) -> Batch:
    """Return images of which no mask and no pose is known.

    Args:
        color: (B, 3, H, W) in [0, 1].
        z: (B, 1, H, W) depth [m].
        K: (B, 3, 3) [px].
    """
    none, unknown = torch.zeros(len(z), dtype=torch.int64), torch.full((len(z),), torch.nan)
    mask, pose = torch.zeros_like(z, dtype=torch.bool), torch.eye(4).expand(len(z), 4, 4)
    return Batch(color, z, mask, K, pose, none, none, unknown)


def _as_channels_last(rgb: Any) -> np.ndarray:
    color = as_array(rgb, "rgb")
    if color.ndim not in (3, 4) or 3 not in (color.shape[-1], color.shape[-3]):
        raise UserError(
            f"rgb: has shape {color.shape}; expected (H, W, 3), or a batch (B, H, W, 3)"
            + (": leave the alpha out, rgb[..., :3]" if color.shape[-1:] == (4,) else "")
        )
    return color if color.shape[-1] == 3 else np.moveaxis(color, -3, -1)


def as_array(value: Any, name: str) -> np.ndarray:
    """Return an array, tensor or nested list as an array.

    Raises:
        UserError: It is none.
    """
    if value is None or isinstance(value, str | Path):
        raise UserError(f"{name}: is {value!r}; must be an array or tensor, not a file name")
    if isinstance(value, np.ma.MaskedArray):
        return np.asarray(value.filled(0))  # masked depth is unknown
    if isinstance(value, torch.Tensor):
        plain = value.detach().to_dense().cpu()
        return np.asarray((plain.float() if plain.dtype == torch.bfloat16 else plain).numpy())
    if isinstance(value, list | tuple):  # of masked arrays, or of tensors with a gradient, too
        parts = (np.ma.MaskedArray, torch.Tensor)
        value = [as_array(one, name) if isinstance(one, parts) else one for one in value]
    try:
        return np.asarray(value)
    except ValueError as error:  # a list of arrays of unequal shape
        raise UserError(f"images: expected arrays of one size ({error})") from error


def _check_color(color: np.ndarray) -> np.ndarray:
    if color.dtype == np.uint8:
        return np.ascontiguousarray(color)
    if color.dtype.kind != "f":
        raise UserError(f"rgb: is {color.dtype}; expected uint8, or float in [0, 1]")
    if not np.isfinite(color).all():
        raise UserError("rgb: holds NaN or infinity")
    if not (color.min() >= 0 and color.max() <= 1):
        raise UserError(
            f"rgb: floats should lie in [0, 1], not in [{color.min():.6g}, {color.max():.6g}]; "
            "numpy.clip(rgb, 0, 1) cuts off what interpolation has added"
        )
    return np.ascontiguousarray(color, dtype=np.float32)


def check_depth_unit(depth: np.ndarray) -> None:
    """Refuse depth (H, W) that cannot be in meters, by a few of its pixels.

    Raises:
        UserError: The median is no distance that a depth camera measures.
    """
    some = drop_unknown(depth[::16, ::16])
    some = some[some > 0]
    if not len(some) or _NEAREST < (median := float(np.median(some))) < _FARTHEST:
        return
    # of noise on a covered sensor a median tells nothing
    if np.count_nonzero(drop_unknown(depth)) >= FEWEST_KNOWN * depth.size:
        raise UserError(f"depth: the median would be {median:.3g} m; is it in meters?")


def drop_unknown(depth: np.ndarray) -> np.ndarray:
    """Return depth as float32, 0 where it is unknown: not finite, not positive, or beyond 100 m, as
    simulators and renderers write where there is nothing.  (..., H, W) [m].

    Where nearly all of it is so far it stays: it is in another unit then.
    """
    if depth.ndim > 2 and len(depth) > 1:  # each image is judged by itself
        return np.stack([drop_unknown(one) for one in depth])
    near = (depth > 0) & (depth < BEYOND)
    if np.count_nonzero(near) < _FEWEST * depth.size:  # else a share of those with depth, too
        known = np.isfinite(depth) & (depth > 0)
        if np.count_nonzero(near) < _FEWEST * np.count_nonzero(known):
            depth, near = np.minimum(depth, np.finfo(np.float32).max), known
    return np.where(near, depth, 0).astype(np.float32)


def _check_depth(depth: np.ndarray, empty: bool) -> np.ndarray:
    if depth.dtype.kind != "f":
        raise UserError(
            f"depth: is {depth.dtype}; expected meters as float: divide by the depth image's units "
            f"in a meter (1000 where it is in millimeters)"
        )
    z = drop_unknown(depth)
    for number, one in enumerate(z):
        which = f" of image {number}" if len(z) > 1 else ""
        if empty and np.count_nonzero(one) < FEWEST_KNOWN * one.size:
            continue  # covered, but for noise
        if not one.any():
            raise UserError(f"depth{which}: no pixel has depth")
        median = float(np.median(one[one > 0]))
        if not _NEAREST < median < _FARTHEST:
            near = np.mean((depth[number] > 0) & (depth[number] < BEYOND))
            where = f" ({near:.1%} of it is within {BEYOND:g} m)" if 0 < near < _FEWEST else ""
            raise UserError(
                f"depth{which}: the median would be {median:.3g} m; is it in meters?{where}"
            )
    return z


def check_intrinsics(K: np.ndarray, count: int, size: tuple[int, int] | None = None) -> np.ndarray:
    """Return camera matrices as float64 (count, 3, 3) [px].

    Args:
        K: Camera matrix (3, 3), or one each (count, 3, 3) [px].
        count: How many are expected.
        size: Height and width of the images [px], for which focal lengths and principal points
            must be plausible; None: not checked.

    Raises:
        UserError: They are none.
    """
    if K.shape not in ((3, 3), (count, 3, 3)) or K.dtype.kind not in "fiu":
        instead = f": {_INSTEAD[K.shape]}" if K.shape in _INSTEAD else ""
        each = f", or one for each image ({count}, 3, 3)" if count > 1 else ""
        raise UserError(
            f"intrinsics: has shape {K.shape} and type {K.dtype}; "
            f"expected a camera matrix (3, 3) [px]{each}{instead}"
        )
    K = np.array(np.broadcast_to(K, (count, 3, 3)), dtype=np.float64)
    if not np.isfinite(K).all():
        raise UserError("intrinsics: hold NaN or infinity")
    for one in K:
        if flaw := find_matrix_flaw(one):
            raise UserError(f"intrinsics: are no camera matrix ({flaw})")
        if size is not None and (flaw := find_focal_flaw(one, size[1])):
            raise UserError(f"intrinsics: focal lengths are not plausible ({flaw})")
        if size is not None and (flaw := find_center_flaw(one, size[1], size[0])):
            raise UserError(f"intrinsics: the principal point is not plausible ({flaw})")
    return K
