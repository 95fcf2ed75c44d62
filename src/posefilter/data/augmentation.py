"""Augmentation of one training sample.  Every operation is exact: the pose, the intrinsics and the
mask stay true.

Operations are small callables `(Sample, draw, rng) -> Sample`, composed by `Compose`; `draw(rng)`
returns another training sample, from which occluders are cut. All randomness comes from the numpy
Generator handed in.
"""

import dataclasses
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.random import Generator

from posefilter.data.frames import Sample
from posefilter.errors import UserError, check_range

Draw = Callable[[Generator], Sample]
Augment = Callable[[Sample, Draw, Generator], Sample]

_LEAST_VISIBLE = 0.05  # below, a few pixels tell little of an object's size
_MOST_ZOOM = 5.0  # beyond, a render is blur


@dataclasses.dataclass(frozen=True)
class Compose:
    """Apply augmentations one after another."""

    steps: Sequence[Augment]

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample after every step."""
        for step in self.steps:
            sample = step(sample, draw, rng)
        return sample


@dataclasses.dataclass(frozen=True)
class RollAndZoom:
    """Turn the camera about its optical axis and change its focal length: both are exact for RGB-D
    images.

    roll: spread of the usual roll [rad]; uniform_roll_probability: that it is uniform instead;
    zoom: range of the factor on the focal length; pivot: the point of the image that stays,
    `center` (the principal point) or `object` (the middle of its mask, so that it may
    be magnified and stay in the frame). A draw that would leave less than the
    share `keep` of the object's pixels in the frame, of as many as it has now or as it would have
    if it is made smaller, is given up.

    object_size: with the probability `object_size_probability` the factor is chosen by the object's
    size in the image instead, so that this is in the range: the square root of the area that it
    would have unoccluded, in image widths. So a filter is trained that searches magnified windows.
    """

    roll: float = 0.15
    uniform_roll_probability: float = 0.25
    zoom: tuple[float, float] = (0.75, 1.3)
    keep: float = 0.7
    pivot: str = "center"
    object_size: tuple[float, float] = (0.16, 0.32)
    object_size_probability: float = 0.0

    def __post_init__(self) -> None:
        if self.pivot not in ("center", "object"):
            raise UserError(f"data.augment: pivot={self.pivot}: choose center or object")
        check_range("data.augment: zoom", self.zoom, 0.0)
        check_range("data.augment: object_size", self.object_size, 0.0)

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample as the turned and zoomed camera sees it."""
        uniform = rng.random() < self.uniform_roll_probability
        angle = rng.uniform(-np.pi, np.pi) if uniform else rng.normal() * self.roll
        zoom = float(np.exp(rng.uniform(*np.log(self.zoom))))
        # without this choice nothing is drawn for it: other trainings stay as they were
        if self.object_size_probability and rng.random() < self.object_size_probability:
            zoom = self._choose_by_size(sample, rng) or zoom
        c, s = np.cos(angle), np.sin(angle)
        K = sample.intrinsics.astype(np.float64)
        K_new = np.diag([zoom, zoom, 1.0]) @ K
        K_new[:2, 2] = K[:2, 2]
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        if self.pivot == "object" and sample.mask.any():
            middle = np.append(np.argwhere(sample.mask).mean(0)[::-1], 1.0)  # u, v, 1 [px]
            K_new[:2, 2] += middle[:2] - (K_new @ turn @ np.linalg.inv(K) @ middle)[:2]
        warp = (K_new @ turn @ np.linalg.inv(K))[:2]
        size = sample.mask.shape[::-1]
        mask = cv2.warpAffine(sample.mask.astype(np.uint8), warp, size, flags=cv2.INTER_NEAREST) > 0
        if mask.sum() < self.keep * sample.mask.sum() * min(zoom * zoom, 1.0):
            return sample
        fill = tuple(float(x) for x in rng.integers(0, 256, 3))
        pose = sample.camera_from_object.astype(np.float64).copy()
        pose[:3] = turn @ pose[:3]
        return dataclasses.replace(
            sample,
            rgb=cv2.warpAffine(sample.rgb, warp, size, flags=cv2.INTER_LINEAR, borderValue=fill),
            depth=cv2.warpAffine(sample.depth, warp, size, flags=cv2.INTER_NEAREST),
            mask=mask,
            intrinsics=K_new.astype(np.float32),
            camera_from_object=pose.astype(np.float32),
            visibility=_keep_visibility(sample, mask, zoom),
        )

    def _choose_by_size(self, sample: Sample, rng: Generator) -> float | None:
        """Return the factor that gives the object a size in the range; None where none is seen."""
        area = int(sample.mask.sum())
        if not area:
            return None
        visible = sample.visibility if np.isfinite(sample.visibility) else 1.0
        size = np.sqrt(area / max(visible, _LEAST_VISIBLE)) / sample.mask.shape[1]
        wanted = np.exp(rng.uniform(*np.log(self.object_size)))
        return float(np.clip(wanted / size, self.zoom[0], _MOST_ZOOM))


def _keep_visibility(sample: Sample, mask: np.ndarray, zoom: float = 1.0) -> float:
    """Return the visible share of which a step leaves a mask, after enlarging it by a factor."""
    whole = sample.mask.sum() * zoom**2
    return sample.visibility * min(float(mask.sum() / whole), 1.0) if whole else sample.visibility


@dataclasses.dataclass(frozen=True)
class RandomCrop:
    """Cut a window of the image: most show the object, at any place in them; the rest are drawn
    from anywhere.

    A network that reads whole images learns as well from windows, and several times as fast.
    size: (height, width) [px], multiples of 32; uniform_probability: that a window is drawn
    without regard to the object.
    """

    size: tuple[int, int] = (160, 192)
    uniform_probability: float = 0.1

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample as a camera with a smaller chip sees it."""
        height, width = sample.mask.shape
        h, w = min(self.size[0], height), min(self.size[1], width)
        top, left = rng.integers(height - h + 1), rng.integers(width - w + 1)
        rows, cols = np.nonzero(sample.mask)
        if len(rows) and rng.random() >= self.uniform_probability:
            at = rng.integers(len(rows))
            top = int(np.clip(rows[at] - rng.integers(h // 8, h - h // 8), 0, height - h))
            left = int(np.clip(cols[at] - rng.integers(w // 8, w - w // 8), 0, width - w))
        cut = np.s_[top : top + h, left : left + w]
        K = sample.intrinsics.copy()
        K[:2, 2] -= (left, top)
        rgb, depth, mask = (x[cut].copy() for x in (sample.rgb, sample.depth, sample.mask))
        return dataclasses.replace(
            sample,
            rgb=rgb,
            depth=depth,
            mask=mask,
            intrinsics=K,
            visibility=_keep_visibility(sample, mask),
        )


def draw_rectangle(
    mask: np.ndarray, size: tuple[float, float], unit: float, rng: Generator
) -> tuple[tuple[slice, slice], np.ndarray, np.ndarray]:
    """Draw a rotated rectangle about some pixel of an object.

    Args:
        mask: (H, W) the object's pixels, one at least.
        size: Range of half its sides, in units.
        unit: [px].
        rng: Source of randomness.

    Returns:
        The part of the image (h, w) that it may cover, and there the coordinates a and b (h, w)
        along its sides, -1 to 1 within it.
    """
    rows, cols = np.nonzero(mask)
    height, width = mask.shape
    at = rng.integers(len(rows))
    half_w, half_h = rng.uniform(*size, 2) * unit
    angle = rng.uniform(0, np.pi)
    reach = int(np.hypot(half_w, half_h)) + 1  # only so much of the image can change
    top, left = max(rows[at] - reach, 0), max(cols[at] - reach, 0)
    cut = np.s_[top : min(rows[at] + reach + 1, height), left : min(cols[at] + reach + 1, width)]
    down, right = np.mgrid[cut].astype(np.float32)
    right, down = right - cols[at], down - rows[at]
    a = (right * np.cos(angle) + down * np.sin(angle)) / half_w
    b = (-right * np.sin(angle) + down * np.cos(angle)) / half_h
    return cut, a, b


@dataclasses.dataclass(frozen=True)
class PasteOccluder:
    """Put a curved patch, cut from another image, in front of the object.

    Leaves at least `keep` of the object's pixels; size in shares of the image width.
    """

    probability: float = 0.6
    size: tuple[float, float] = (0.04, 0.18)
    keep: float = 0.25

    def __post_init__(self) -> None:
        check_range("data.augment: size", self.size, 0.0)

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample with the occluder's color and depth pasted in and the mask cut."""
        if rng.random() >= self.probability or not sample.mask.any():
            return sample
        cut, a, b = draw_rectangle(sample.mask, self.size, sample.mask.shape[1], rng)
        patch = (np.maximum(np.abs(a), np.abs(b)) if rng.random() < 0.5 else np.hypot(a, b)) < 1
        mask = sample.mask.copy()
        mask[cut] &= ~patch
        if mask.sum() < self.keep * sample.mask.sum():
            return sample
        # of what is seen of the object: the origin of its mesh may be anywhere
        seen = sample.depth[sample.mask & (sample.depth > 0)]
        distance = float(np.median(seen)) if seen.size else float(sample.camera_from_object[2, 3])
        if distance <= 0:
            return sample
        distance *= rng.uniform(0.72, 0.94)
        surface = distance * (1 - 0.05 * (1 - a * a) + 0.03 * b * rng.normal())
        behind = sample.depth[cut][patch]
        known = behind[behind > 0]
        if known.size:
            # a deep object reaches further to the camera than most of what is seen of it
            surface *= min(1.0, 0.98 * known.min() / surface[patch].max())
        drawn = draw(rng).rgb
        if drawn.shape != sample.rgb.shape:  # images of several sizes
            drawn = cv2.resize(drawn, sample.mask.shape[::-1], interpolation=cv2.INTER_AREA)
        other = jitter_color(drawn[cut], rng, 1.0)
        rgb, depth = sample.rgb.copy(), sample.depth.copy()
        rgb[cut][patch], depth[cut][patch] = other[patch], surface[patch]
        visibility = _keep_visibility(sample, mask)
        return dataclasses.replace(sample, rgb=rgb, depth=depth, mask=mask, visibility=visibility)


@dataclasses.dataclass(frozen=True)
class RandomErasing:
    """Lose rectangles of depth (holes) or paint rectangles of color (stickers, glare)."""

    max_rectangles: int = 5
    size: tuple[float, float] = (0.02, 0.18)

    def __post_init__(self) -> None:
        check_range("data.augment: size", self.size, 0.0)
        if self.max_rectangles < 0:
            raise UserError(f"data.augment: max_rectangles={self.max_rectangles}: is below 0")

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample with up to `max_rectangles` rectangles blanked."""
        rgb, depth = sample.rgb.copy(), sample.depth.copy()
        height, width = depth.shape
        for _ in range(rng.integers(0, self.max_rectangles + 1)):
            h, w = (rng.uniform(*self.size, 2) * width).astype(int) + 1
            top, left = rng.integers(height), rng.integers(width)
            if rng.random() < 0.5:
                depth[top : top + h, left : left + w] = 0
            else:
                rgb[top : top + h // 2 + 1, left : left + w // 2 + 1] = rng.integers(0, 256, 3)
        return dataclasses.replace(sample, rgb=rgb, depth=depth)


@dataclasses.dataclass(frozen=True)
class DepthNoise:
    """Scale depth as a badly calibrated sensor does, and add noise that grows with z squared.

    The noise of an image is white at half its size, of a standard deviation that is uniform from 0
    to `noise`, and enlarged bilinearly, which leaves 0.6 of it.
    """

    scale: float = 0.004  # standard deviation
    noise: float = 0.0015  # [1/m]: the largest standard deviation at 1 m, in meters

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample with noisy depth; unknown pixels stay unknown."""
        d = sample.depth
        coarse = rng.standard_normal((d.shape[0] // 2, d.shape[1] // 2), dtype=np.float32)
        grain = cv2.resize(coarse, d.shape[::-1], interpolation=cv2.INTER_LINEAR)
        factor = np.float32(1 + rng.normal() * self.scale)
        noise = np.float32(self.noise * rng.uniform())
        # 0, unknown, stays 0
        return dataclasses.replace(sample, depth=d * (factor + d * grain * noise))


@dataclasses.dataclass(frozen=True)
class ColorJitter:
    """Jitter white balance, exposure, gamma, contrast and saturation, blur and add noise; strength
    1 is strong.
    """

    strength: float = 1.0

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample under another camera and light."""
        return dataclasses.replace(sample, rgb=jitter_color(sample.rgb, rng, self.strength))


def jitter_color(rgb: np.ndarray, rng: Generator, strength: float) -> np.ndarray:
    """Return the image (H, W, 3) uint8 as another camera under another light would have taken
    it; with a strength of 0 as it is.
    """
    k = strength
    gain = np.exp(rng.normal(size=3) * 0.1 * k + rng.normal() * 0.25 * k)
    gamma = np.exp(rng.normal() * 0.2 * k)
    contrast = np.exp(rng.normal() * 0.25 * k)
    saturation = np.exp(rng.normal() * 0.3 * k)
    levels = np.arange(256) / 255.0
    curves = [0.5 + (np.clip(levels * g, 1e-4, 1) ** gamma - 0.5) * contrast for g in gain]
    table = (np.clip(np.stack(curves, -1), 0, 1) * 255).astype(np.uint8)[None]
    # towards or away from the gray of each pixel
    mix = np.eye(3) * saturation + (1 - saturation) / 3
    out = cv2.transform(cv2.LUT(rgb, table).astype(np.float32), mix)
    if rng.random() < 0.4 * k:
        out = cv2.GaussianBlur(out, (0, 0), rng.uniform(0.3, 1.1))
    if rng.random() < 0.5:
        each, common = (rng.standard_normal((*rgb.shape[:2], n), dtype=np.float32) for n in (3, 1))
        out = out + (each + common) * np.float32(0.7 * 255 * 0.06 * k * rng.random() ** 2)
    if k == 0:  # after all draws, so that later steps have theirs; the table rounds down
        return rgb
    return np.clip(out, 0, 255).astype(np.uint8)
