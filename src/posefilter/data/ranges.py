"""Ranges of the data's settings: a value that makes no sense is refused in one line, by its key."""

import math
from collections.abc import Mapping
from typing import Any

from posefilter.errors import UserError
from posefilter.limits import MOST_SIDE

# least and most that can be meant; null is for the defaults
RANGES: dict[str, tuple[float, float]] = {
    "min_visibility": (0, 1),
    "min_visibility_test": (0, 1),
    "batch_size": (1, 100_000),
    "batch_size_test": (1, 100_000),
    "workers": (0, 256),
    "limit_train": (1, math.inf),
    "limit_val": (1, math.inf),
    "limit_test": (1, math.inf),
    "points": (4, 1_000_000),
    "image_width": (16, MOST_SIDE),
    "image_height": (16, MOST_SIDE),
    "split_seed": (0, math.inf),
    "seed": (0, math.inf),
}


def check_ranges(settings: Mapping[str, Any]) -> None:
    """Check the settings that `RANGES` knows; None passes.

    Args:
        settings: Values by the name of the setting.

    Raises:
        UserError: One is no number, or outside of its range.
    """
    for name, (least, most) in RANGES.items():
        value = settings.get(name)
        if value is None:
            continue
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (number and least <= value <= most):  # NaN too
            bounds = f"at least {least}" + (f", at most {most}" if most < math.inf else "")
            raise UserError(f"data.{name}={value}: must be a number, {bounds}")
