"""Sets of poses with a guaranteed coverage: split conformal prediction, by group.

The nonconformity score of a pose is the mean log density of the belief's own particles, less the
log density at that pose. Of n calibration frames of a group, with their truths' scores in rising
order, the set of level p of a new frame holds every pose whose score is at most the ceil(p (n +
1))-th; if there are fewer, it holds every pose. Where the new frame and the calibration frames of
its group are exchangeable, the set holds the truth with a probability of at least p, whatever the
belief is worth (Vovk et al. 2005; by group: Mondrian conformal prediction).

The groups are told apart by the calibrated probability, at the quantiles of the calibration frames.
A belief that is likely to be wrong gives the truth a far higher score than one that is likely to be
right, so that one limit for all would cover too much of the sure ones and too little of the others.
The probability of a calibration frame is that of a regression that has not seen it, as new frames
are not seen either. Where the frames of the sets are others than the regression's (`calibrate.py
sets_only=true`) it is the same regression, and the guarantee holds; else it is one of five, fitted
to the other frames (cross-conformal prediction, Vovk 2015), and the guarantee holds nearly: see
docs/results/confidence.md for what was measured.  Calibrations of before have two groups, by the
feature `surface` at a fixed limit.

Little of the object visible is harder than the probability shows, and a new frame's visibility is
not known. A group that has enough calibration frames with less than a quarter visible therefore
takes the larger of two limits, its own and that of these frames alone: the sets of such new frames
hold the truth with a probability of at least p, and so do those of the others where these frames
are no easier (after Barber et al. 2021, who take the largest limit over all large subsets).

References:
    Vovk, Gammerman, Shafer: Algorithmic Learning in a Random World. Springer (2005).
    Vovk: Cross-conformal predictors. Annals of Mathematics and Artificial Intelligence 74 (2015).
    Barber, Candes, Ramdas, Tibshirani: The limits of distribution-free conditional predictive
        inference. Information and Inference 10 (2021).
"""

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

By = Literal["surface", "probability"]
GROUPED_BY: tuple[str, ...] = get_args(By)
_FEWEST = 20  # frames of a group: with as many, a set of 95 % is not that of all poses
# of the frames, below each limit between groups: the surest are much alike, the others are not; the
# finest for which the frames suffice
_SHARES = ((0.05, 0.15, 0.25, 0.45, 0.7), (0.1, 0.25, 0.45, 0.7))
_EVEN = 4  # groups at most where frames are too few for these
LITTLE_VISIBLE = 0.25  # a frame with less counts for the second limit of its group
# that a second limit takes at least: frames of a group, and their share of it, since where they are
# rare it would only make the sets of all others larger
_FEWEST_OCCLUDED, _LEAST_OCCLUDED = 5, 0.2


@dataclass(frozen=True)
class Conformal:
    """Nonconformity scores of calibration frames, by group; plain data, part of a calibration.

    Attributes:
        edges: Limits between groups, of the feature `surface` or of the probability, rising.
        scores: Of each group, in rising order [nat]; one group more than there are edges.
        by: What the groups are told apart by.
        occluded: Those scores of each group whose frames show less than LITTLE_VISIBLE of the
            object, in rising order [nat]; empty: of an earlier version, or not known.
    """

    edges: tuple[float, ...]
    scores: tuple[tuple[float, ...], ...]
    by: By = "surface"
    occluded: tuple[tuple[float, ...], ...] = ()

    def find_group(self, value: float) -> int:
        """Return the group of a frame by its feature or probability; NaN is in the first."""
        return 0 if math.isnan(value) else bisect.bisect_right(self.edges, value)

    def find_limit(self, level: float, value: float) -> float:
        """Return the largest score of a pose that is in a set.

        Args:
            level: Least probability that the set holds the truth.
            value: Of the frame: its probability, or its feature `surface`; see `by`.

        Returns:
            The limit [nat], which never falls as the level rises; infinite where the group's frames
            are too few for the level. Where its occluded frames are, the largest of them counts.
        """
        group = self.find_group(value)
        own, occluded = self.scores[group], self.occluded[group] if self.occluded else ()
        limit = _find_quantile(own, level)
        if len(occluded) < max(_FEWEST_OCCLUDED, _LEAST_OCCLUDED * len(own)):
            return limit
        return max(limit, min(_find_quantile(occluded, level), occluded[-1]))


def _find_quantile(scores: Sequence[float], level: float) -> float:
    """Return the ceil(level (n + 1))-th of n scores in rising order; infinite if there is none."""
    rank = math.ceil(round(level * (len(scores) + 1), 9))
    return math.inf if rank > len(scores) or not scores else scores[max(rank, 1) - 1]


def choose_edges(probability: np.ndarray) -> tuple[float, ...]:
    """Return limits between six groups, of 5, 10, 10, 20, 25 and 30 % of the frames.

    Below 400 frames there are five, of 10, 15, 20, 25 and 30 %, and below 200 fewer, of as many
    frames each, and of 20 at least.

    (n,) probabilities of the frames.
    """
    count = len(probability)
    even = max(1, min(_EVEN, count // _FEWEST))
    enough = [shares for shares in _SHARES if round(shares[0] * count, 6) >= _FEWEST]
    shares = enough[0] if enough else tuple(k / even for k in range(1, even))
    return tuple(float(one) for one in np.unique(np.quantile(probability, shares)))


def fit_conformal(
    scores: np.ndarray, probability: np.ndarray, visibility: np.ndarray | None = None
) -> Conformal:
    """Sort the nonconformity scores of calibration frames into groups by their probabilities.

    Args:
        scores: (n,) of the truths [nat].
        probability: (n,) of the frames.
        visibility: (n,) of the object in the frames; NaN where it is not known. None: of no frame.
    """
    edges = choose_edges(probability)  # without looking at the scores
    empty = Conformal(edges, ((),) * (len(edges) + 1))
    group = np.array([empty.find_group(float(one)) for one in probability], dtype=int)

    def sort(some: np.ndarray) -> tuple[tuple[float, ...], ...]:
        own = (np.sort(scores[some & (group == k)]) for k in range(len(edges) + 1))
        return tuple(tuple(one.tolist()) for one in own)

    whole = sort(np.ones(len(scores), dtype=bool))
    known = visibility is not None
    occluded = sort(np.asarray(visibility) < LITTLE_VISIBLE) if known else ()
    return Conformal(edges, whole, "probability", occluded)
