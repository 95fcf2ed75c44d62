"""Simulate an RGB-D camera: color of a cheap color camera, depth of structured light.

The depth's defects follow a Kinect-like sensor: quantized disparity (so errors grow with z
squared), correlated noise, a slowly varying offset, ragged edges, shadows on one side where the
projector does not reach, holes on dark and shiny surfaces, a maximum range.
"""

import cv2
import numpy as np

from posefilter.synthetic.textures import blurred_noise, noise_field

SENSORS = ("ideal", "kinect")


def simulate_sensor(
    rgb: np.ndarray, depth: np.ndarray, sensor: str, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate the images of a camera.

    Args:
        rgb: (H, W, 3) float32, 1 = white.
        depth: (H, W) float32 [m], 0 = nothing there.
        sensor: One of `SENSORS`; "ideal" changes nothing.
        rng: Source of randomness.

    Returns:
        The photograph (H, W, 3) uint8 RGB, and the depth (H, W) float32 [m], 0 = no measurement.
    """
    photo, measured = np.clip(rgb, 0, 1), depth
    if sensor != "ideal":
        photo = simulate_color(rgb, rng)
        measured = simulate_depth(depth, photo, rng)
    return (photo * 255 + 0.5).astype(np.uint8), measured


def simulate_color(rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Simulate a cheap color camera.  (H, W, 3) float32 -> (H, W, 3) float32 in [0, 1]."""
    height, width = rgb.shape[:2]
    balance = np.exp(rng.normal(0, 0.07, 3) + rng.normal(0, 0.22)).astype(np.float32)
    out = rgb * balance
    out = _vary_brightness(out, rng)
    mean = out.mean((0, 1))
    out = mean + (out - mean) * np.float32(rng.uniform(0.8, 1.35))
    gray = out.mean(-1, keepdims=True)
    out = gray + (out - gray) * np.float32(rng.uniform(0.6, 1.4))
    out = np.clip(out, 0, 1.05) ** np.float32(rng.uniform(0.75, 1.35))
    out = _blur(out, 0.3 + rng.uniform(0, 1.1) * width / 640)
    if rng.random() < 0.25:
        kernel = motion_kernel(rng, int(rng.integers(3, max(4, 9 * width // 640))))
        out = np.asarray(cv2.filter2D(out, -1, kernel), np.float32)
    out = out + _color_noise(rng, height, width)
    if rng.random() < 0.6:
        out = out + np.float32(rng.uniform(0.3, 1.5)) * (out - _blur(out, rng.uniform(0.8, 1.6)))
    return np.clip(out, 0, 1)


def simulate_depth(depth: np.ndarray, photo: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Simulate a structured-light camera.

    Args:
        depth: (H, W) [m], 0 = nothing there.
        photo: (H, W, 3) in [0, 1]; dark and overexposed surfaces have more holes.
        rng: Source of randomness.

    Returns:
        (H, W) float32 [m], 0 = no measurement.
    """
    height, width = depth.shape
    out = _jitter_edges(depth, rng)
    valid = out > 0
    fine = blurred_noise(rng, height, width, rng.uniform(0.8, 3) * width / 640)
    coarse = rng.standard_normal((5, 6), dtype=np.float32)
    slow = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    out = out * np.float32(1 + rng.normal(0, 0.0025))
    out = out + out * out * (
        fine * np.float32(rng.uniform(0.0004, 0.0022)) + slow * np.float32(0.0012)
    )
    if rng.random() < 0.75:  # a Kinect's step is 1/8 px of disparity: some 0.0029 / m
        step = np.float32(rng.uniform(0.3, 1) * 0.0029)
        out = 1 / (np.maximum(np.round(1 / np.maximum(out, 0.1) / step), 1) * step)
    out[~valid] = 0
    out[_lose_edges(depth, rng)] = 0
    out[_lose_surfaces(depth, photo, rng)] = 0
    if rng.random() < 0.5:
        out[depth > rng.uniform(1.5, 3.5)] = 0
    out[out > 6.5] = 0
    return out


def _blur(image: np.ndarray, sigma: float) -> np.ndarray:
    """Blur an image by a Gaussian of sigma [px]."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.float32)


def _vary_brightness(rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Vary the brightness slowly over the image, as a near lamp or a lens does."""
    coarse = 1 + rng.uniform(0, 0.25) * rng.uniform(-1, 1, (3, 4)).astype(np.float32)
    coarse = coarse.astype(np.float32)
    return rgb * cv2.resize(coarse, rgb.shape[1::-1], interpolation=cv2.INTER_CUBIC)[..., None]


def motion_kernel(rng: np.random.Generator, length: int) -> np.ndarray:
    """Return the kernel of motion blur: a line of `length` pixels in a random direction.

    It is about its middle pixel, so that the image stays in its place.
    """
    middle = length // 2
    side = 2 * middle + 1
    line = np.zeros((side, side), np.float32)
    line[middle] = 1
    if length < side:
        line[middle, [0, -1]] = 0.5
    turn = cv2.getRotationMatrix2D((middle, middle), rng.uniform(0, 180), 1)
    kernel = cv2.warpAffine(line, turn, (side, side))
    return kernel / max(float(kernel.sum()), 1e-6)


def _color_noise(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Return sensor noise of brightness, and coarser noise of color, as demosaicing leaves it."""
    bright = rng.standard_normal((height, width, 1), dtype=np.float32)
    bright *= np.float32(rng.uniform(0.004, 0.04))
    coarse = rng.standard_normal((height // 2, width // 2, 3), dtype=np.float32)
    coarse *= np.float32(rng.uniform(0.002, 0.03))
    return bright + cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)


def _jitter_edges(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the depth sampled on a jittered grid, shifted by about a pixel against the color."""
    height, width = depth.shape
    scale = width / 640
    grid = np.empty((2, height, width), np.float32)
    for axis in range(2):
        jitter = blurred_noise(rng, height, width, 1.5)
        grid[axis] = jitter * np.float32(rng.uniform(0.2, 1.35) * scale) + np.float32(
            rng.normal(0, scale)
        )
    grid[0] += np.arange(width, dtype=np.float32)
    grid[1] += np.arange(height, dtype=np.float32)[:, None]
    return cv2.remap(depth, grid[0], grid[1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)


def _lose_edges(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return where depth is lost at discontinuities, on one side or both.  -> (H, W) bool."""
    height, width = depth.shape
    scale = width / 640
    box = np.ones((3, 3), np.uint8)
    jump = (cv2.dilate(depth, box) - cv2.erode(depth, box)) > 0.025
    wide, high = (max(1, round(float(rng.uniform(1, n)) * scale)) for n in (9, 5))
    kernel = np.zeros((2 * high + 1, 2 * wide + 1), np.uint8)
    kernel[:, wide if rng.random() < 0.5 else 0 :] = 1
    band = cv2.dilate(jump.astype(np.uint8), kernel) > 0
    coarse = rng.standard_normal((height // 8, width // 8), dtype=np.float32)
    rag = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return band & (rag > rng.uniform(-2, 0.8))


def _lose_surfaces(depth: np.ndarray, photo: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return holes in surfaces, more of them where it is dark or overexposed.  -> (H, W) bool."""
    height, width = depth.shape
    if rng.random() < 0.3:
        return np.zeros((height, width), bool)
    blotch = noise_field(rng, 256, (16, 32, 64, 128))
    side = max(width, height)
    blotch = cv2.resize(blotch, (side, side), interpolation=cv2.INTER_LINEAR)[:height, :width]
    bright = photo.mean(-1)
    bad = blotch + 0.15 * ((bright < 0.1) | (bright > 0.97))
    share = rng.uniform(0, 1) ** 2 * 0.08
    return bad > np.quantile(bad[::4, ::4], 1 - share)
