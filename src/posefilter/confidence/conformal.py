"""Sets of poses with a guaranteed coverage: split conformal prediction, by group.

The surprise of a pose is the mean log density of the belief's own particles, less the log density
at that pose.  Of n calibration frames of a group, with their truths' surprises in rising order, the
set of level p of a new frame holds every pose whose surprise is at most the ceil(p (n + 1))-th; if
there are fewer, it holds every pose.  Where the new frame and the calibration frames of its group
are exchangeable, the set holds the truth with a probability of at least p, whatever the belief is
worth (Vovk et al. 2005; by group: Mondrian conformal prediction).  The groups are told apart by
what is measured at the estimate, at limits that are fixed beforehand.

References:
    Vovk, Gammerman, Shafer: Algorithmic Learning in a Random World. Springer (2005).
"""

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

# of the evidence `surface`: about half of an object's surface faces the camera, so that below a
# quarter the depth shows less than half of what could be seen
EDGES = (0.25,)


@dataclass(frozen=True)
class Conformal:
    """The surprises of calibration frames, by group; plain data, carried in a calibration.

    Attributes:
        edges: Limits between groups, of the evidence `surface`, rising.
        surprises: Of each group, in rising order [nat]; one group more than there are edges.
    """

    edges: tuple[float, ...]
    surprises: tuple[tuple[float, ...], ...]

    def find_group(self, surface: float) -> int:
        """Return the group of a frame by its evidence `surface`; NaN is in the first."""
        return 0 if math.isnan(surface) else bisect.bisect_right(self.edges, surface)

    def find_limit(self, level: float, surface: float) -> float:
        """Return the largest surprise of a pose that is in a set.

        Args:
            level: Least probability that the set holds the truth.
            surface: Of the frame; see `measure_depth`.

        Returns:
            The limit [nat]; infinite where the group's frames are too few for the level.
        """
        own = self.surprises[self.find_group(surface)]
        rank = math.ceil(round(level * (len(own) + 1), 9))
        return math.inf if rank > len(own) else own[max(rank, 1) - 1]


def fit_conformal(
    surprises: np.ndarray, surface: np.ndarray, edges: Sequence[float] = EDGES
) -> Conformal:
    """Sort the surprises of calibration frames into groups.

    Args:
        surprises: (n,) of the truths [nat].
        surface: (n,) evidence of the frames.
        edges: Limits between groups, chosen without looking at these frames.
    """
    empty = Conformal(tuple(edges), ((),) * (len(edges) + 1))
    group = np.array([empty.find_group(float(one)) for one in surface], dtype=int)
    own = [np.sort(surprises[group == k]).tolist() for k in range(len(edges) + 1)]
    return Conformal(empty.edges, tuple(tuple(one) for one in own))
