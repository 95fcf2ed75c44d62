"""The visible surface discrepancy (VSD): how much of what is seen of an object is elsewhere at the
estimated pose (Hodan, Michel et al. 2018, "BOP: Benchmark for 6D Object Pose Estimation").

Ambiguous poses have no error by it: only the surface that is visible is compared.  Definitions are
those of the challenge since 2019 (`vsd` and `estimate_visib_mask` of bop_toolkit, mode "bop19"):
the cost of a pixel is a step, and a pixel without measured depth counts as visible.
"""

import numpy as np

DELTA = 0.015  # [m] tolerance of visibility, that of the challenge for most datasets
TAUS = tuple(0.05 * i for i in range(1, 11))  # diameters by which a pixel may be misaligned
VSD_THRESHOLDS = TAUS  # shares of the pixels, below which an error counts as correct


def to_distance(depth: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Return the distance of each pixel's point from the camera's center.

    Args:
        depth: (H, W) z-depth [m], 0 where unknown.
        intrinsics: (3, 3) camera matrix [px].

    Returns:
        (H, W) float64 [m], 0 where unknown.
    """
    height, width = depth.shape
    x = (np.arange(width) - intrinsics[0, 2]) / intrinsics[0, 0]
    y = (np.arange(height) - intrinsics[1, 2]) / intrinsics[1, 1]
    return depth * np.sqrt(1 + x[None] ** 2 + y[:, None] ** 2)


def vsd(
    estimate: np.ndarray,
    truth: np.ndarray,
    measured: np.ndarray,
    intrinsics: np.ndarray,
    diameter: float,
) -> np.ndarray:
    """Return the visible surface discrepancy.

    Args:
        estimate: (H, W) depth of the object alone, rendered at the estimated pose [m], 0 elsewhere.
        truth: The same at the true pose.
        measured: (H, W) depth of the image [m], 0 where unknown.
        intrinsics: (3, 3) camera matrix [px].
        diameter: The object's diameter [m].

    Returns:
        (T,) in [0, 1], for each of `TAUS`; 1 where nothing is visible of either.
    """
    there, guess, seen = (to_distance(d, intrinsics) for d in (truth, estimate, measured))
    visible = _is_visible(there, seen)
    claimed = _is_visible(guess, seen) | (visible & (guess > 0))
    both, either = visible & claimed, int((visible | claimed).sum())
    if either == 0:
        return np.ones(len(TAUS))
    apart = np.abs(there[both] - guess[both]) / diameter
    alone = either - int(both.sum())
    return np.array([(int((apart >= tau).sum()) + alone) / either for tau in TAUS])


def _is_visible(model: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return where a rendered object is not hidden, by distances (H, W) [m]."""
    return (model > 0) & ((model - seen <= DELTA) | (seen == 0))
