"""What the registry says of a number follows from what the number is: its unit from the end of its
key, its axis from what it may be, its digits from what is counted or measured.
"""

import math
import re

import pytest

from posefilter.metrics.registry import HIGHER, LOWER, METRICS, NEITHER, MetricInfo, find_metric

every = pytest.mark.parametrize("info", METRICS.values(), ids=METRICS.keys())

STORED_AS_PERCENT = r"auc$|recall|/ar$|/ar_|coverage|score$"
WITHIN_ONE = r"iou$|auroc"  # from 0 to 1
WITHIN_SIGNED_ONE = r"cosine$"  # from -1 to 1; R² has no least
COUNTS = (
    "instances", "missed", "confidence/frames", "confidence/frames_without",
    "confidence/false_alarms", "scale_ratio/images", "scale_ratio/contradicting",
    "training/steps", "training/tested_step", "not_finite",
)  # fmt: skip


@every
def test_a_number_is_shown_in_the_unit_that_it_is_stored_in_or_a_handier_one(
    info: MetricInfo,
) -> None:
    """One meter is 1000 mm, a half turn 180 degrees, and a share of 1 is 100 %."""
    ends = {"_m": (1000, "mm"), "_mm": (1, "mm"), "_px": (1, "px"), "_rad": (180 / math.pi, None)}
    for end, (factor, unit) in ends.items():
        if info.key.endswith(end):
            assert info.convert(1.0) == pytest.approx(factor)
            assert info.unit == (unit or "degrees")
    if info.unit == "%":
        already = re.search(STORED_AS_PERCENT, info.key)
        assert info.convert(1.0) == (1 if already else 100)
    elif not info.key.endswith(("_m", "_rad")):
        assert info.convert(1.0) == 1


@every
def test_an_axis_shows_all_that_a_number_can_be_and_little_more(info: MetricInfo) -> None:
    if info.unit == "%" or re.search(STORED_AS_PERCENT, info.key):
        low, high = 0, 100
    elif re.search(WITHIN_ONE, info.key):
        low, high = 0, 1
    elif re.search(WITHIN_SIGNED_ONE, info.key):
        low, high = -1, 1
    else:
        assert info.limits is None
        return
    assert info.limits is not None
    for margin in (low - info.limits[0], info.limits[1] - high):
        assert 0.02 * (high - low) < margin < 0.04 * (high - low)


@every
def test_the_digits_are_those_that_mean_something(info: MetricInfo) -> None:
    """Counts have no fraction; a number of the size of 1 has two or three digits after the point,
    and a duration three in all, however short.
    """
    if info.key in COUNTS:
        assert info.format(12) == "12"
    elif info.unit == "s" or info.key == "train/loss":
        assert info.format(0.0123456) == "0.0123"
    elif info.limits and info.limits[1] < 2:
        assert info.format(0.5) in ("0.50", "0.500")
    elif (
        info.key in ("belief/rank", "belief/entropy", "scale_ratio/ratio", "diagnostics/offset_r2")
        or "log_density" in info.key
    ):
        assert info.format(0.5) == "0.50"
    elif re.search(r"coverage|filter/ess", info.key):
        assert info.format(50 / info.factor) == "50"
    elif info.key in ("confidence/ece", "confidence/brier"):
        assert info.format(0.5) == "0.500"
    else:
        assert info.format(12.34 / info.factor) == "12.3"


@every
def test_which_way_is_better(info: MetricInfo) -> None:
    """Errors, times, alarms and what is lost should be small; what is right, found or told apart
    should be large; how wide a belief is, and how many there are, is neither good nor bad.
    """
    worse = (
        r"median|seconds|missed|off_frame|near_|pairwise|outscored|ece|brier|wrong|absent|alarms|contradicting"
        r"|loss|drop|not_finite"
    )
    better = (
        r"auc|recall|/ar$|iou|on_object|mass|log_density|auroc|found|distinct|r2|offset_cosine"
        r"|^(?:best_)?score$|likelihood"
    )
    neither = r"instances|effective|entropy|spread|rank|frames|first_axis_share|steps?$|ess$|sigma"
    if re.search(worse, info.key):
        assert info.direction == LOWER
    elif re.search(better, info.key):
        assert info.direction == HIGHER
    elif re.search(neither, info.key):
        assert info.direction == NEITHER


def test_ways_to_be_better_are_told_apart() -> None:
    assert (HIGHER, LOWER, NEITHER) == (1, -1, 0)  # a difference times it is the gain


def test_a_column_without_a_short_name_has_the_label() -> None:
    assert find_metric("add/recall_01d").column == "ADD < 0.1 d %"
    assert find_metric("add/recall_2cm").column == "ADD < 2 cm %"
    assert find_metric("missed").column == "missed"
    assert find_metric("missed").title == "missed"
    assert find_metric("missed").describe(3) == "3"
    assert find_metric("confidence/ece").column == "ECE"
