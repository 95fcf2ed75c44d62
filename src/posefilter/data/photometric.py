"""Photometric augmentation: a color model of real cameras.

The sensor model of the renderer and the color jitter of `augmentation.py` leave hues where the
texture has them. Real cameras do not: their filters mix the channels, their white balance tints,
and scans of textures are faded. Each step here is a callable `(Sample, draw, rng) -> Sample` that
changes color alone; pose, camera, depth and mask stay as they are. A step of strength 0 returns the
image bit for bit, and but for `Sticker` takes as many draws as at any other strength.
"""

import dataclasses

import cv2
import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from posefilter.data.augmentation import Draw, draw_rectangle
from posefilter.data.frames import Sample
from posefilter.errors import UserError, check_range
from posefilter.synthetic.sensor import motion_kernel


@dataclasses.dataclass(frozen=True)
class ColorResponse:
    """Draw the color response of another camera and apply it to the image, or to the object alone.

    Applied are, in this order: a gamma curve, and one 3 x 3 matrix, the product of a tint, a mixing
    of channels and a rotation of hue.
    """

    # standard deviations: of the rotation about the gray axis, of the mixing matrix's off-diagonal
    # entries, of the logarithms of each channel's gain and of the exponent
    hue_deg: float = 14.0
    mixing: float = 0.12
    tint: float = 0.12
    gamma: float = 0.2
    gain: tuple[float, float] = (1.0, 1.0)  # range, of all channels, uniform in its logarithm
    target: str = "image"  # "object": the mask's pixels alone, as faded or retouched texture has it
    probability: float = 1.0  # share of samples that are changed

    def __post_init__(self) -> None:
        if self.target not in ("image", "object"):
            raise UserError(f"augment: target={self.target}: choose image or object")
        check_range("data.augment: gain", self.gain, 0.0)

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample with another color response."""
        chosen = rng.random() < self.probability
        hue = np.deg2rad(rng.normal() * self.hue_deg)
        mixing = mixing_matrix(rng.normal(size=6) * self.mixing)
        tint = np.diag(tint_gains(rng.normal(size=3) * self.tint))
        exponent = float(np.exp(rng.normal() * self.gamma))
        gain = float(np.exp(rng.uniform(*np.log(self.gain))))
        if not chosen:
            return sample
        matrix = gain * tint @ mixing @ hue_rotation(hue)
        if self.target == "image":
            return dataclasses.replace(sample, rgb=respond(sample.rgb, matrix, exponent))
        if not sample.mask.any():
            return sample
        rgb = sample.rgb.copy()
        rgb[sample.mask] = respond(sample.rgb[sample.mask][:, None], matrix, exponent)[:, 0]
        return dataclasses.replace(sample, rgb=rgb)


@dataclasses.dataclass(frozen=True)
class Vignette:
    """Darken the image towards its corners, by at most `strength` (a share of the brightness) in
    the corner itself.
    """

    strength: float = 0.35

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample with darker corners."""
        height, width = sample.mask.shape
        gain = vignette(height, width, float(rng.uniform(0, self.strength)))
        return dataclasses.replace(sample, rgb=_to_bytes(sample.rgb * gain[..., None]))


@dataclasses.dataclass(frozen=True)
class Highlights:
    """Overexpose: brighten so that the brightest areas are clipped."""

    gain: float = 0.2  # scale of the half-normal log gain
    probability: float = 0.3

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample, overexposed or not."""
        chosen, gain = rng.random() < self.probability, np.exp(abs(rng.normal()) * self.gain)
        if not chosen:
            return sample
        return dataclasses.replace(sample, rgb=_to_bytes(sample.rgb * np.float32(gain)))


@dataclasses.dataclass(frozen=True)
class MotionBlur:
    """Blur along a line, as a moving camera does."""

    length: float = 0.02  # of the longest line, as a share of the image width
    probability: float = 0.2

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample, blurred or not."""
        chosen = rng.random() < self.probability
        length = rng.uniform(0, self.length) * sample.mask.shape[1]
        kernel = motion_kernel(rng, max(1, round(float(length))))
        if not chosen or len(kernel) < 2:
            return sample
        blurred = cv2.filter2D(sample.rgb, -1, kernel, borderType=cv2.BORDER_REPLICATE)
        return dataclasses.replace(sample, rgb=np.asarray(blurred))


@dataclasses.dataclass(frozen=True)
class Jpeg:
    """Compress the image as a JPEG, and read it back."""

    quality: tuple[int, int] = (40, 95)  # range; 100 is best
    probability: float = 0.3

    def __post_init__(self) -> None:
        check_range("data.augment: quality", self.quality, 0.0)

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample, compressed or not."""
        chosen = rng.random() < self.probability
        quality = int(rng.integers(self.quality[0], self.quality[1] + 1))
        if not chosen:
            return sample
        _, data = cv2.imencode(".jpg", sample.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
        decoded = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))
        return dataclasses.replace(sample, rgb=np.ascontiguousarray(decoded[..., ::-1]))


@dataclasses.dataclass(frozen=True)
class Sticker:
    """Stick a printed label on the object: real objects carry labels that their meshes lack.

    The label is a rotated rectangle, cut off where the object ends; it still belongs to the object.
    """

    probability: float = 0.4  # share of samples with a label
    size: tuple[float, float] = (0.15, 0.5)  # of its sides, in roots of the object's visible area
    white: float = 0.7  # share of labels that are nearly white; the others have any color
    printed: float = 0.5  # share of labels with dark bars

    def __post_init__(self) -> None:
        check_range("data.augment: size", self.size, 0.0)

    def __call__(self, sample: Sample, draw: Draw, rng: Generator) -> Sample:
        """Return the sample with or without a label."""
        if rng.random() >= self.probability or not sample.mask.any():
            return sample
        scale = np.sqrt(sample.mask.sum())
        cut, a, b = draw_rectangle(sample.mask, self.size, scale / 2, rng)
        label = (np.maximum(np.abs(a), np.abs(b)) < 1) & sample.mask[cut]
        paper = rng.uniform(190, 255) + rng.normal(size=3) * 8
        paper = paper if rng.random() < self.white else rng.uniform(0, 255, 3)
        bars = np.sin(a * rng.uniform(6, 20) + rng.uniform(0, 6)) > rng.uniform(-0.5, 0.8)
        bars &= (np.maximum(np.abs(a), np.abs(b)) < 0.8) & (rng.random() < self.printed)
        color = np.where(bars[..., None], rng.uniform(0, 0.5), 1.0) * paper
        rgb = sample.rgb.copy()
        rgb[cut][label] = _to_bytes(color[label])
        return dataclasses.replace(sample, rgb=rgb)


def hue_rotation(angle: float) -> np.ndarray:
    """Return the rotation (3, 3) of RGB by an angle [rad] about the gray axis: gray and the
    channels' mean stay.
    """
    return np.asarray(Rotation.from_rotvec(np.full(3, angle / np.sqrt(3))).as_matrix())


def mixing_matrix(off_diagonal: np.ndarray) -> np.ndarray:
    """Return the matrix (3, 3) with these six off-diagonal entries, row by row, whose rows sum to
    one: gray stays gray.
    """
    matrix = np.zeros((3, 3))
    matrix[~np.eye(3, dtype=bool)] = off_diagonal
    return matrix + np.diag(1 - matrix.sum(1))


def tint_gains(log_gains: np.ndarray) -> np.ndarray:
    """Return gains (3,) of the channels whose product is one: the tint alone, no exposure."""
    return np.exp(log_gains - log_gains.mean())


def vignette(height: int, width: int, strength: float) -> np.ndarray:
    """Return the gains of a vignette.  -> (height, width) float32.

    They are 1 in the middle and 1 - strength in the corners, and fall with the squared radius.
    """
    y = np.linspace(-1, 1, height, dtype=np.float32)[:, None]
    x = np.linspace(-1, 1, width, dtype=np.float32)[None, :]
    return (1 - np.float32(strength) * (x * x + y * y) / 2).astype(np.float32)


def respond(rgb: np.ndarray, matrix: np.ndarray, exponent: float) -> np.ndarray:
    """Return colors (H, W, 3) uint8 after a gamma curve and a linear map, clipped."""
    table = ((np.arange(256) / 255.0) ** exponent * 255).astype(np.float32)
    return _to_bytes(cv2.transform(cv2.LUT(rgb, table), matrix))


def _to_bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
