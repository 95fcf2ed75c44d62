"""Intervals over scenes: frames of a scene are alike, so that scenes are drawn anew, not images."""

from collections.abc import Callable, Sequence

import numpy as np


def bootstrap_scenes(
    scenes: Sequence[str], measure: Callable[[list[int]], float], draws: int = 1000
) -> tuple[float, float]:
    """Return the ends of the 95 % interval of a figure (percentile bootstrap).

    Args:
        scenes: (N,) names, of each image.
        measure: Given rows, of which some are there several times; returns the figure.
        draws: Of the bootstrap.
    """
    names = sorted(set(scenes))
    rows = [[i for i, scene in enumerate(scenes) if scene == name] for name in names]
    rng = np.random.default_rng(0)
    figures = []
    for _ in range(draws):
        chosen = rng.integers(len(names), size=len(names))
        figures.append(measure([i for one in chosen for i in rows[one]]))
    low, high = np.percentile(figures, [2.5, 97.5])
    return float(low), float(high)
