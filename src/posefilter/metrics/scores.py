"""Summaries of many errors.

Errors (N,) [m]: one for each instance that was there; a missed one is infinite.
"""

from torch import Tensor

from posefilter.errors import UserError


def auc(errors: Tensor, limit: float = 0.1) -> float:
    """Return the area under accuracy against threshold up to `limit`, in [0, 100], as published for
    YCB-Video.

    The VOC way (Xiang et al. 2018, their toolbox): accuracy i / N at the i-th smallest error below
    the limit, summed as steps of the right endpoint, and of the last accuracy from the largest of
    them to the limit. NaN without instances.
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
    """Return the share of instances with an error below the threshold, one for all or one each, in
    [0, 100].
    """
    return float(100 * (errors < threshold).double().mean())


def median_mm(errors: Tensor) -> float:
    """Return the median in millimeters; infinite where half the instances or more are missed, NaN
    where there are none.

    Of an even number, the mean of the middle two.
    """
    if len(errors) == 0:
        return float("nan")
    ordered = errors.double().sort().values
    middle = ordered[[(len(errors) - 1) // 2, len(errors) // 2]]
    return float(1000 * middle.mean())


def summary(errors: Tensor, diameter: float | Tensor) -> dict[str, float]:
    """Return the block of metrics.json for one kind of error.  (N,) [m], () or (N,) [m]."""
    if bool(errors.isnan().any()):
        raise UserError("an error is not a number: a pose holds NaN; count it as missed instead")
    return {
        "auc": auc(errors),
        "recall_01d": recall(errors, 0.1 * diameter),
        "recall_2cm": recall(errors, 0.02),
        "median_mm": median_mm(errors),
    }


def overall(add_auc: float | None, on_object: float, iou: float) -> float:
    """Return the one figure that chooses between checkpoints and between runs, in [0, 100]; more is
    better.

    The ADD AUC where poses are told; of a detector (None) the mean of particles on the object and
    box IoU, both shares: its particles may all be on the object long before the box that they tell
    fits it.
    """
    return 50.0 * (on_object + iou) if add_auc is None else add_auc
