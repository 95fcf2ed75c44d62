"""Sets of poses that hold a truth with a stated probability: regions of highest density."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, eq=False)
class PoseSet:
    """A highest-density region (Hyndman 1996): all poses at which a belief is dense enough.

    Attributes:
        coverage: The probability that the set is made to hold the truth with; what it is of, the
            belief's mass or frames, is its maker's matter (credible or conformal).
        min_log_density: The threshold: the least log density of a pose in the set; minus infinity
            where every pose is in it.
        samples: The particles in it (K, 4, 4), camera_from_object [m], one of those that are the
            same; of more than 2,000 particles a selection.
        weights: Their weights (K,) in the belief, with those that they stand for.
        log_density: The belief's log density at poses; see `Belief.log_density`.
    """

    coverage: float
    min_log_density: float
    samples: np.ndarray = field(repr=False)
    weights: np.ndarray = field(repr=False)
    log_density: Callable[[np.ndarray], np.ndarray] = field(repr=False)

    @property
    def level(self) -> float:
        """The earlier name of `coverage`."""
        return self.coverage

    @property
    def least(self) -> float:
        """The earlier name of `min_log_density`."""
        return self.min_log_density

    @property
    def is_everything(self) -> bool:
        """Whether every pose is in the set."""
        return self.min_log_density == -np.inf

    def contains(self, poses: np.ndarray) -> np.ndarray:
        """Tell which poses are in the set.

        Args:
            poses: (*, 4, 4) camera_from_object [m].

        Returns:
            (*) bool.
        """
        return np.asarray(self.log_density(poses) >= self.min_log_density)
