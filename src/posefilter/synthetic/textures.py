"""Draw random textures of tables, floors, walls and boxes."""

from collections.abc import Sequence

import cv2
import numpy as np

Color = np.ndarray  # (3,) float in [0, 1]


def noise_field(
    rng: np.random.Generator, size: int, octaves: Sequence[int] = (4, 8, 16, 32, 64)
) -> np.ndarray:
    """Return smooth noise in [0, 1], a sum of octaves with random weights.  -> (size, size)
    float32.
    """
    field = np.zeros((size, size), np.float32)
    for cells in octaves:
        coarse = rng.standard_normal((cells, cells), dtype=np.float32)
        field += cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC) * np.float32(
            rng.uniform(0.1, 1)
        )
    field -= field.min()
    return field / max(float(field.max()), 1e-6)


def blurred_noise(rng: np.random.Generator, height: int, width: int, sigma: float) -> np.ndarray:
    """Return noise of unit spread, smooth over sigma [px].  -> (height, width) float32."""
    raw = rng.standard_normal((height, width), dtype=np.float32)
    smooth: np.ndarray = cv2.GaussianBlur(raw, (0, 0), sigma)
    return smooth / np.float32(max(float(smooth.std()), 1e-6))


def random_color(rng: np.random.Generator) -> Color:
    """Draw a color of indoor scenes: often gray or brown.  -> (3,) in [0, 1]."""
    kind = rng.random()
    if kind < 0.4:
        color = np.full(3, rng.uniform(0.03, 1)) + rng.normal(0, 0.03, 3)
    elif kind < 0.65:
        color = np.array([0.55, 0.38, 0.24]) * rng.uniform(0.3, 1.7) + rng.normal(0, 0.05, 3)
    elif kind < 0.73:
        color = np.array([0.7, 0.1, 0.1]) * rng.uniform(0.4, 1.3) + rng.normal(0, 0.07, 3)
    else:
        color = rng.uniform(0, 1, 3)
    return np.clip(color, 0, 1)


def plain(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw one color with faint stains."""
    stains = noise_field(rng, size) - 0.5
    return random_color(rng) + stains[..., None] * rng.uniform(0, 0.12)


def checker(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw tiles in two colors, or all in one with joints."""
    cell = size // int(rng.integers(2, 9))
    row, column = np.indices((size, size))
    if rng.random() < 0.5:
        first = ((row // cell + column // cell) % 2 == 0)[..., None]
    else:
        first = ((row % cell > cell * 0.05) & (column % cell > cell * 0.05))[..., None]
    return np.where(first, random_color(rng), random_color(rng))


def marble(rng: np.random.Generator, size: int) -> np.ndarray:
    """Mix three colors by smooth noise."""
    a, b, c = (random_color(rng) for _ in range(3))
    out = a + (b - a) * noise_field(rng, size)[..., None]
    veins = noise_field(rng, size, (32, 64, 128)) * rng.uniform(0, 0.8)
    return out + (c - out) * veins[..., None]


def wood(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw grain: noise drawn out along one side."""
    base = np.array([0.62, 0.42, 0.25]) * rng.uniform(0.35, 1.5) + rng.normal(0, 0.04, 3)
    field = noise_field(rng, size, (16, 32, 64, 128))
    strip = field[: max(2, size // int(rng.choice([8, 16, 32])))]
    grain = cv2.resize(strip, (size, size), interpolation=cv2.INTER_LINEAR)
    out = base * (1 + (grain[..., None] - 0.5) * rng.uniform(0.2, 0.9))
    return out.transpose(1, 0, 2) if rng.random() < 0.5 else out


def carpet(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw pile: a color with strong fine speckle."""
    speckle = rng.standard_normal((size, size), dtype=np.float32)
    if rng.random() < 0.5:
        speckle = blurred_noise(rng, size, size, rng.uniform(0.5, 2))
    color = random_color(rng) * rng.uniform(0.4, 1)
    return color * (1 + rng.uniform(0.1, 0.5) * speckle[..., None])


def stripes(rng: np.random.Generator, size: int) -> np.ndarray:
    """Draw stripes of a few colors, one after another."""
    colors = np.stack([random_color(rng) for _ in range(int(rng.integers(2, 5)))])
    band = (np.arange(size) * int(rng.integers(3, 20)) // size) % len(colors)
    out = np.broadcast_to(colors[band][None], (size, size, 3))
    return out.transpose(1, 0, 2) if rng.random() < 0.5 else out


def label(rng: np.random.Generator, size: int, base: Color | None = None) -> np.ndarray:
    """Draw a printed face: rectangles, discs and lines of writing on one color."""
    paper = random_color(rng) if base is None else np.clip(base + rng.normal(0, 0.05, 3), 0, 1)
    out = np.ones((size, size, 3)) * paper
    for _ in range(int(rng.integers(3, 14))):
        a, b = np.sort(rng.integers(0, size, (2, 2)), axis=0)
        if rng.random() < 0.25:
            center = tuple(int(x) for x in (a + b) // 2)
            cv2.circle(out, center, int(max(2, (b - a).min() // 2)), random_color(rng).tolist(), -1)
        else:
            out[a[0] : b[0] + 1, a[1] : b[1] + 1] = random_color(rng)
    for _ in range(int(rng.integers(1, 8))):
        _write(rng, out, size)
    return out


def _write(rng: np.random.Generator, out: np.ndarray, size: int) -> None:
    """Draw rows of strokes that look like text."""
    ink = random_color(rng).tolist()
    height = int(rng.integers(3, max(5, size // 10)))
    top, left = (int(x) for x in rng.integers(0, size - 2 * height, 2))
    right = int(rng.integers(left + height, size + 1))
    for row in range(int(rng.integers(1, 6))):
        x, y = left, top + row * int(height * 1.6)
        while x < right and y + height < size:
            step = int(rng.integers(1, height + 1))
            cv2.rectangle(out, (x, y), (x + step, y + height), ink, -1)
            x += step + int(rng.integers(1, height + 1))


_KINDS = (plain, checker, marble, wood, carpet, stripes, label)


def random_texture(
    rng: np.random.Generator,
    size: int = 256,
    photos: Sequence[np.ndarray] = (),
    weights: Sequence[float] | None = None,
) -> np.ndarray:
    """Draw a texture of a random kind, or crop it from a photo.

    Args:
        rng: Source of randomness.
        size: Width and height [px].
        photos: Images (h, w, 3) uint8 to crop from.
        weights: Of plain, checker, marble, wood, carpet, stripes, label; None: equal.

    Returns:
        (size, size, 3) uint8 RGB.
    """
    if len(photos) and rng.random() < 0.15:
        out = crop_texture(rng, photos[int(rng.integers(len(photos)))], size)
    else:
        share = np.ones(len(_KINDS)) if weights is None else np.asarray(weights, float)
        kind = int(rng.choice(len(_KINDS), p=share / share.sum()))
        out = _KINDS[kind](rng, size)
    grain = rng.choice([0.0, 0.02, 0.06]) * rng.standard_normal((size, size, 1))
    return to_uint8(out + grain)


def crop_texture(rng: np.random.Generator, photo: np.ndarray, size: int) -> np.ndarray:
    """Crop a square from an image, with permuted colors half of the time.

    Returns:
        (size, size, 3) float in [0, 1].
    """
    side = int(rng.integers(min(photo.shape[:2]) // 8 + 1, min(photo.shape[:2]) // 2 + 2))
    row, column = (int(rng.integers(0, n - side + 1)) for n in photo.shape[:2])
    cut = photo[row : row + side, column : column + side]
    out = cv2.resize(cut, (size, size), interpolation=cv2.INTER_AREA)
    if rng.random() < 0.5:
        out = out[..., rng.permutation(3)]
    return out / 255.0


def recolor(rng: np.random.Generator, texture: np.ndarray) -> np.ndarray:
    """Return a texture with its color channels permuted (never the identity) or inverted.

    A permutation changes gray little or not at all.
    """
    orders = ((1, 0, 2), (2, 1, 0), (1, 2, 0), (2, 0, 1), (0, 2, 1))
    out = texture[..., list(orders[int(rng.integers(len(orders)))])]
    return 255 - out if rng.random() < 0.15 else np.ascontiguousarray(out)


def find_dominant_color(texture: np.ndarray) -> Color:
    """Return the mean color (3,) of the largest bin of a coarse histogram, black left out."""
    small = cv2.resize(texture, (64, 64), interpolation=cv2.INTER_AREA).reshape(-1, 3)
    small = small[small.max(1) > 40] if (small.max(1) > 40).any() else small
    cell = (small // 43).astype(int) @ [36, 6, 1]
    return small[cell == np.bincount(cell).argmax()].mean(0) / 255


def to_uint8(colors: np.ndarray) -> np.ndarray:
    """Convert colors in [0, 1] to uint8."""
    return np.ascontiguousarray(np.clip(colors * 255 + 0.5, 0, 255).astype(np.uint8))
