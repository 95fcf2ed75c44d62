"""Place further instances of the target beside it."""

import numpy as np

from posefilter.synthetic.placing import Placed, Table, View, place_distractor

_ATTEMPTS = 8  # places that are tried for an instance


def place_copies(
    target: Placed,
    count: int,
    view: View,
    table: Table | None,
    wanted: float,
    largest_truncation: float,
    rng: np.random.Generator,
) -> list[Placed] | None:
    """Find poses for further instances of the target.

    Args:
        target: The first instance.
        count: How many more.
        view: The camera.
        table: The table, if there is one.
        wanted: Fraction of the first instance that should stay visible.
        largest_truncation: Share of an instance's outline that may be out of the frame.
        rng: Source of randomness.

    Returns:
        All instances, the first in front; None where one finds no place.
    """
    placed = [target]
    for _ in range(count):
        for _ in range(_ATTEMPTS):
            one = place_distractor(target.solid, placed, view, table, wanted, False, rng)
            if one is not None and view.holds(one, largest_truncation):
                placed.append(one)
                break
        else:
            return None
    return placed
