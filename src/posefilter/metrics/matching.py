"""Match estimates to the instances that are there, as the BOP challenge does."""

import numpy as np


def match_greedily(errors: np.ndarray, threshold: float) -> list[tuple[int, int]]:
    """Match estimates to truths: each estimate, by falling confidence, takes the free truth of the
    least error, if that is below the threshold (Hodan et al. 2016, "On Evaluation of 6D Object Pose
    Estimation", section 3.2; `match_poses` of bop_toolkit).

    Args:
        errors: (R, T) of each estimate, the most confident first, against each truth.
        threshold: An error below it is a match.

    Returns:
        Pairs of an estimate and a truth, each in one pair at most.
    """
    free = np.ones(errors.shape[1], dtype=bool)
    pairs = []
    for row, own in enumerate(errors):
        open_errors = np.where(free, own, np.inf)
        if not len(open_errors):
            break
        best = int(open_errors.argmin())
        if open_errors[best] < threshold:
            free[best] = False
            pairs.append((row, best))
    return pairs
