"""Metrics in the form of metrics.json: flat names, and one score."""

from collections.abc import Mapping
from typing import Any

from posefilter.errors import UserError
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


def to_numbers(results: Any, who: str, key: str = "") -> Any:
    """Return nested results as metrics.json has them: a metric's tensor of no dimension, and a
    scalar of NumPy, become a number.

    Args:
        results: Mappings and lists of numbers, texts and None.
        who: What computed them.
        key: The joined name of their place.

    Raises:
        UserError: A value is none of these.
    """
    if isinstance(results, Mapping):
        below = f"{key}/" if key else ""
        return {str(name): to_numbers(one, who, f"{below}{name}") for name, one in results.items()}
    if isinstance(results, list | tuple):
        return [to_numbers(one, who, key) for one in results]
    shape = getattr(results, "shape", None)
    value = results.item() if shape == () else results
    if not (value is None or isinstance(value, int | float | str)):
        kind = f"{type(value).__name__}{'' if shape is None else f' of shape {(*shape,)}'}"
        raise UserError(f"{who}: '{key}' is a {kind}, not a number")
    return value
