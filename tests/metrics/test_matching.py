"""Matching of estimates to truths: greedy by confidence, as the BOP challenge does it."""

import numpy as np

from posefilter.metrics.matching import match_greedily


def test_the_more_confident_takes_the_nearest_that_is_free() -> None:
    errors = np.array([[0.3, 0.1], [0.2, 0.05], [0.9, 0.4]])
    assert match_greedily(errors, 0.5) == [(0, 1), (1, 0)]
    # by least total error the second would have had the second truth; greedy does not look ahead
    assert match_greedily(errors, 0.15) == [(0, 1)]
    assert match_greedily(errors, 0.1) == [(1, 1)]  # below, not at the threshold


def test_each_is_matched_once_at_most_and_only_below_the_threshold() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        errors = rng.random((int(rng.integers(0, 6)), int(rng.integers(0, 6))))
        pairs = match_greedily(errors, 0.6)
        for side in (0, 1):
            taken = [pair[side] for pair in pairs]
            assert len(set(taken)) == len(taken)
        assert all(errors[pair] < 0.6 for pair in pairs)
        free = set(range(errors.shape[1])) - {t for _, t in pairs}
        missed = set(range(errors.shape[0])) - {r for r, _ in pairs}
        assert not any(errors[r, t] < 0.6 for r in missed for t in free)
