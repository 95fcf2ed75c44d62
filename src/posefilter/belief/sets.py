"""Sets of poses that hold a truth with a stated probability: level sets of a belief's density."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class PoseSet:
    """All poses at which a belief's density is high enough.

    Attributes:
        level: The probability that the set is made for.
        least: The least log density of a pose in the set; minus infinity where every pose is in it.
        samples: The particles in it (K, 4, 4), camera_from_object [m]; of more than 2,000 particles
            a selection.
        weights: Their weights (K,) in the belief.
        log_density: The belief's log density at poses; see `Belief.log_density`.
    """

    level: float
    least: float
    samples: np.ndarray
    weights: np.ndarray
    log_density: Callable[[np.ndarray], np.ndarray]

    @property
    def is_everything(self) -> bool:
        """Whether every pose is in the set."""
        return self.least == -np.inf

    def contains(self, poses: np.ndarray) -> np.ndarray:
        """Tell which poses are in the set.

        Args:
            poses: (*, 4, 4) camera_from_object [m].

        Returns:
            (*) bool.
        """
        return np.asarray(self.log_density(poses) >= self.least)


def find_least(values: np.ndarray, weights: np.ndarray, level: float) -> float:
    """Return the largest number such that `level` of the weight has values of at least that.

    (N,), (N,) that sum to 1 -> a value.
    """
    order = np.argsort(-values, kind="stable")
    mass = np.cumsum(weights[order])
    return float(values[order][min(int(np.searchsorted(mass, level - 1e-9)), len(values) - 1)])
