"""Sample textures without aliasing."""

import cv2
import numpy as np

_ROW = 4096  # cv2.remap takes no side above 32767, so samples are folded into rows of this length
_KEPT = 256  # textures whose levels stay in memory


def sample_texture(texture: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Sample a texture bilinearly; it repeats beyond its edges.

    Args:
        texture: (h, w, 3) uint8.
        u: (P,) from left to right, 1 for the width.
        v: (P,) from bottom to top, 1 for the height.

    Returns:
        Colors (P, 3) float32 in [0, 1].
    """
    h, w = texture.shape[:2]
    n = len(u)
    fold = np.zeros((2, -(-n // _ROW) * _ROW), np.float32)
    fold[0, :n] = (u - np.floor(u)) * w - 0.5
    fold[1, :n] = (1 - (v - np.floor(v))) * h - 0.5
    x, y = fold.reshape(2, -1, _ROW)
    out = cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return out.reshape(-1, 3)[:n] * np.float32(1 / 255)


class MipmapCache:
    """Mipmap levels of textures, computed on first use."""

    def __init__(self) -> None:
        # by id; the first level is the texture, so that its id stays its own
        self._levels: dict[int, list[np.ndarray]] = {}

    def level(self, texture: np.ndarray, texels_per_pixel: float) -> np.ndarray:
        """Return the level at which one texel is about one pixel."""
        key = id(texture)
        if key not in self._levels:
            while len(self._levels) >= _KEPT:
                del self._levels[next(iter(self._levels))]
            self._levels[key] = [texture]
        levels = self._levels[key]
        wanted = int(np.clip(np.floor(np.log2(max(texels_per_pixel, 1e-6)) + 0.25), 0, 6))
        while len(levels) <= wanted and min(levels[-1].shape[:2]) >= 8:
            half = cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            levels.append(half)
        return levels[min(wanted, len(levels) - 1)]
