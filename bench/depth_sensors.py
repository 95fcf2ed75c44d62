"""What other depth sensors do to a depth image: alterations of a sample, in turn of a bench.

YCB-Video's camera is a structured-light one, registered well. Others are not: the depth lies some
pixels beside the color, is wrong by a constant factor, is lost in places, waves, or, where it is
matched in blocks from two images, puts the edges of what is near too far out and smears them.
"""

import dataclasses

import cv2
import numpy as np
from numpy.random import Generator

from posefilter.data.augmentation import Augment, Compose, Draw
from posefilter.data.frames import Sample

_FAR = 1000.0  # [m] beyond all that is measured


@dataclasses.dataclass(frozen=True)
class Shift:
    """Move the depth against the color, in a random direction."""

    pixels: float

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample with depth from so many pixels away."""
        angle = rng.uniform(0, 2 * np.pi)
        move = self.pixels * np.array([np.cos(angle), np.sin(angle)])
        shift, size = np.column_stack([np.eye(2), move]), sample.depth.shape[::-1]
        depth = cv2.warpAffine(sample.depth, shift, size, flags=cv2.INTER_NEAREST)
        return dataclasses.replace(sample, depth=depth)


@dataclasses.dataclass(frozen=True)
class Scale:
    """Make all depth wrong by a factor, up or down."""

    share: float

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample with every depth too large or too small by the share."""
        factor = 1 + self.share * rng.choice([-1, 1])
        return dataclasses.replace(sample, depth=sample.depth * np.float32(factor))


@dataclasses.dataclass(frozen=True)
class Lose:
    """Lose a share of the depth, in blotches."""

    share: float
    blotch: float  # [px] standard deviation of what the blotches are smoothed by

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample with depth of 0 there."""
        field = draw_field(sample.depth.shape, self.blotch, rng)
        lost = field > np.quantile(field, 1 - self.share)
        return dataclasses.replace(sample, depth=np.where(lost, np.float32(0), sample.depth))


@dataclasses.dataclass(frozen=True)
class Wave:
    """Add noise that grows with the square of the depth and is alike in neighboring pixels."""

    noise: float  # standard deviation at 1 m [m]
    width: float  # [px]

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample with noisy depth; unknown pixels, which are 0, stay unknown."""
        field = draw_field(sample.depth.shape, self.width, rng)
        depth = sample.depth + np.float32(self.noise) * sample.depth**2 * field
        return dataclasses.replace(sample, depth=depth)


@dataclasses.dataclass(frozen=True)
class GrowForeground:
    """Let what is near grow over what is behind it, as matching in blocks does."""

    pixels: int

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample with the least depth of each square of pixels."""
        far = np.where(sample.depth > 0, sample.depth, np.float32(_FAR))
        near = cv2.erode(far, np.ones((2 * self.pixels + 1,) * 2, np.uint8))
        # OpenCV's border is farther still
        return dataclasses.replace(sample, depth=np.where(near < _FAR, near, np.float32(0)))


@dataclasses.dataclass(frozen=True)
class Smear:
    """Average depth over edges, so that points float between what is near and what is far."""

    width: float  # [px]

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample with smoothed depth; unknown pixels take no part, and stay unknown."""
        known = sample.depth > 0
        share = cv2.GaussianBlur(known.astype(np.float32), (0, 0), self.width)
        mean = cv2.GaussianBlur(sample.depth, (0, 0), self.width) / np.maximum(share, 1e-3)
        return dataclasses.replace(sample, depth=np.where(known, mean, np.float32(0)))


def draw_field(shape: tuple[int, ...], width: float, rng: Generator) -> np.ndarray:
    """Return smooth noise (H, W) float32 of standard deviation 1."""
    field = cv2.GaussianBlur(rng.standard_normal(shape, dtype=np.float32), (0, 0), width)
    return np.asarray(field / field.std())


SENSORS: dict[str, Augment] = {
    "beside by 3 px": Shift(3),
    "by 6 px": Shift(6),
    "off by 1 %": Scale(0.01),
    "by 2 %": Scale(0.02),
    "half lost": Lose(0.5, 8),
    "waves of 4 mm": Wave(0.004, 4),
    "of 10 mm": Wave(0.010, 6),
    "stereo": Compose([GrowForeground(3), Smear(2), Wave(0.004, 5), Scale(0.01), Lose(0.2, 8)]),
}
