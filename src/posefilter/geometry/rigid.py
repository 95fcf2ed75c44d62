"""Rigid transforms (4, 4) of single poses, in numpy."""

from collections.abc import Sequence

import numpy as np


def rigid(rotation: np.ndarray, translation: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return a rigid transform (4, 4) of a rotation (3, 3) and a translation (3,) [m]."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, translation
    return out


def move(points_b: np.ndarray, a_from_b: np.ndarray) -> np.ndarray:
    """Map points of frame b into frame a; the linear part may scale.  (P, 3), (4, 4) -> (P, 3)."""
    return points_b @ a_from_b[:3, :3].T + a_from_b[:3, 3]
