"""Summary statistics of pose errors.

Errors are (N,) [m], one for each instance; a missed one is infinite.
"""

from typing import NamedTuple

from torch import Tensor

from posefilter.errors import UserError


class InstanceErrors(NamedTuple):
    """The errors of N instances, and the diameters of their objects: (N,) each [m]."""

    add: Tensor
    add_s: Tensor
    diameter: Tensor
    add_up_to_symmetry: Tensor  # that of `add` where the object has no symmetries


def auc(errors: Tensor, limit: float = 0.1) -> float:
    """Return the area under the accuracy-threshold curve up to `limit`, in [0, 100].

    As in the YCB-Video toolbox (Xiang et al. 2018), computed the VOC way: accuracy i / N at the
    i-th smallest error below the limit, summed as steps of the right endpoint; the last accuracy
    extends to the limit. NaN without instances.
    """
    if len(errors) == 0:
        return float("nan")
    within = errors.double()[errors < limit].sort().values
    if len(within) == 0:
        return 0.0
    accuracy = within.new_ones(len(within)).cumsum(0) / len(errors)
    widths = within.diff(prepend=within.new_zeros(1))
    area = (widths * accuracy).sum() + (limit - within[-1]) * accuracy[-1]
    return float(100 * area / limit)


def recall(errors: Tensor, threshold: float | Tensor) -> float:
    """Return the percentage of instances with an error below the threshold.

    Args:
        errors: (N,) [m].
        threshold: One for all, or (N,) [m].
    """
    return float(100 * (errors < threshold).double().mean())


def median(errors: Tensor) -> float:
    """Return the median; of an even number, the mean of the middle two.

    Infinite if half the instances or more are missed; NaN without instances.
    """
    if len(errors) == 0:
        return float("nan")
    ordered = errors.double().sort().values
    return float(ordered[[(len(errors) - 1) // 2, len(errors) // 2]].mean())


def summarize(errors: Tensor, diameter: float | Tensor) -> dict[str, float]:
    """Return the block of metrics.json for one kind of error.

    Args:
        errors: (N,) [m].
        diameter: () or (N,) [m].

    Raises:
        UserError: An error is NaN.
    """
    if bool(errors.isnan().any()):
        raise UserError("an error is not a number: a pose holds NaN; count it as missed instead")
    return {
        "auc": auc(errors),
        "recall_01d": recall(errors, 0.1 * diameter),
        "recall_2cm": recall(errors, 0.02),
        "median_mm": 1000 * median(errors),
    }


def summarize_errors(errors: InstanceErrors, symmetric: bool) -> dict[str, dict[str, float]]:
    """Return the blocks `add` and `add_s` of metrics.json, and `add_up_to_symmetry` if asked."""
    blocks = {
        "add": summarize(errors.add, errors.diameter),
        "add_s": summarize(errors.add_s, errors.diameter),
    }
    if symmetric:
        blocks["add_up_to_symmetry"] = summarize(errors.add_up_to_symmetry, errors.diameter)
    return blocks


def overall(add_auc: float | None, on_object: float, iou: float) -> float:
    """Return the score that selects checkpoints and ranks runs, in [0, 100]; higher is better.

    It is the ADD AUC; of an object with symmetries that of ADD up to symmetry, since by plain ADD a
    turn that no image shows would decide. For detectors, which predict no pose (None), it is the
    mean of the share of particles on the object and the box IoU: particles can all be on the object
    long before the predicted box is accurate.
    """
    return 50.0 * (on_object + iou) if add_auc is None else add_auc
