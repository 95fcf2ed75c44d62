"""Metrics in the form of metrics.json: flat names, and one score."""

from collections.abc import Mapping
from typing import Any

from posefilter.metrics.scores import overall


def compute_checkpoint_score(results: dict[str, Any]) -> float:
    """Return the score by which checkpoints are compared, from metrics.json (see `overall`)."""
    return score_numbers(flatten(results))


def score_numbers(numbers: Mapping[str, float], missing: float = 0.0) -> float:
    """Return the score of numbers by their joined names (see `overall`).

    Args:
        numbers: As `flatten` returns them.
        missing: What a detector's number that is not there counts as.
    """
    auc = numbers.get(f"{find_error(numbers)}/auc")
    on_object, iou = (numbers.get(name, missing) for name in ("particles_on_object", "iou"))
    return overall(auc, on_object, iou)


def find_error(numbers: Mapping[str, float]) -> str:
    """Return the name of the error that poses are judged by: where it is known, the ADD up to
    symmetry.
    """
    return "add_up_to_symmetry" if "add_up_to_symmetry/auc" in numbers else "add"


def flatten(results: Mapping[str, Any], prefix: str = "") -> dict[str, float]:
    """Return nested numbers by joined names; values that are no numbers are left out."""
    out: dict[str, float] = {}
    for name, value in results.items():
        if isinstance(value, Mapping):
            out |= flatten(value, f"{prefix}{name}/")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            out[prefix + name] = float(value)
    return out
