"""Metrics of calibrated probabilities, against counting and against known answers."""

import math

import pytest
import torch

from posefilter.metrics.confidence import (
    Confidence,
    calibration_error,
    error_at_coverage,
    list_bins,
)


def test_calibration_error_is_the_mean_gap_of_the_bins() -> None:
    probability = torch.tensor([0.05, 0.05, 0.95, 0.95, 0.95, 0.95])
    right = torch.tensor([False, True, True, True, True, False])
    # two bins: |0.05 - 0.5| and |0.95 - 0.75|
    assert float(calibration_error(probability, right)) == pytest.approx(
        (2 * 0.45 + 4 * 0.2) / 6, abs=1e-6
    )
    assert math.isnan(calibration_error(probability[:0], right[:0]))


def test_calibration_error_is_that_of_the_diagram_at_the_limits_of_bins_too() -> None:
    """A limit is no float32: 0.3 lies below that of torch's linspace."""
    probability = torch.tensor([0.3, 0.38, 0.22], dtype=torch.float64)
    right = torch.tensor([True, False, False])
    gaps = [
        one["frames"] * abs(one["probability"] - one["right"])
        for one in list_bins(probability, right)
    ]
    assert float(calibration_error(probability, right)) == pytest.approx(sum(gaps) / 3)
    assert sum(gaps) == pytest.approx(2 * 0.16 + 0.22)


def test_labels_drawn_from_the_probabilities_have_little_calibration_error() -> None:
    probability = torch.rand(20_000, dtype=torch.float64)
    right = torch.rand(20_000, dtype=torch.float64) < probability
    assert float(calibration_error(probability, right)) < 0.02
    assert float(calibration_error(probability, ~right)) > 0.3


def test_refusing_the_least_probable_leaves_the_errors_of_the_rest() -> None:
    probability = torch.tensor([0.9, 0.8, 0.7, 0.6, 0.1])
    right = torch.tensor([True, True, False, True, False])
    assert float(error_at_coverage(probability, right, 1.0)) == pytest.approx(0.4)
    assert float(error_at_coverage(probability, right, 0.8)) == pytest.approx(0.25)
    assert float(error_at_coverage(probability, right, 0.4)) == 0
    ties = torch.full((10,), 0.5)
    wrong = torch.arange(10) < 3
    assert float(error_at_coverage(ties, ~wrong)) == pytest.approx(0.3)


def test_frames_without_the_object_count_for_presence_and_false_alarms_alone() -> None:
    metric = Confidence()
    own = torch.tensor([True, True, True, False])
    metric.update(
        torch.tensor([0.9, 0.8, 0.7, 0.6]),
        torch.tensor([0.9, 0.5, 0.6, 0.1]),
        own,
        torch.tensor([True, False, True, False]),
        torch.tensor([1.0, 0.0, -1.0, 1.0]),
    )
    told = metric.compute()
    assert (told["frames"], told["frames_without"], told["false_alarms"]) == (3, 1, 1)
    assert told["auroc"] == 1
    assert told["auroc_presence"] == 1
    assert told["wrong"] == pytest.approx(1 / 3)
    assert told["found"] == pytest.approx(1 / 3)
    assert told["absent"] == pytest.approx(1 / 3)
    assert told["brier"] == pytest.approx((0.01 + 0.25 + 0.16 + 0.01) / 4, abs=1e-6)


def test_the_bins_of_the_reliability_diagram_hold_every_frame_once() -> None:
    probability = torch.tensor([0.0, 0.05, 0.3, 0.95, 1.0, 0.99])
    right = torch.tensor([False, True, False, True, True, False])
    found = list_bins(probability, right)
    assert [(one["from"], one["to"], one["frames"]) for one in found] == [
        (0.0, 0.1, 2),
        (0.3, 0.4, 1),
        (0.9, 1.0, 3),
    ]
    assert [one["right"] for one in found] == pytest.approx([0.5, 0, 2 / 3])
    assert found[0]["probability"] == pytest.approx(0.025)
    gap = sum(one["frames"] * abs(one["probability"] - one["right"]) for one in found) / 6
    assert gap == pytest.approx(float(calibration_error(probability, right)))


def test_alarms_are_false_where_the_object_is_not() -> None:
    """Of four frames with the object three are declared found; of three without, two."""
    metric = Confidence()
    there = torch.tensor([True] * 4 + [False] * 3)
    verdict = torch.tensor([1.0, 1.0, 1.0, -1.0, 1.0, 1.0, 0.0])
    right = there & (torch.arange(7) < 2)
    probability = torch.tensor([0.9, 0.8, 0.7, 0.2, 0.6, 0.5, 0.1])
    metric.update(probability, probability, there, right, verdict)
    told = metric.compute()
    assert (told["frames"], told["frames_without"], told["false_alarms"]) == (4, 3, 2)
    assert (told["found"], told["absent"], told["wrong"]) == (0.75, 0.25, 0.5)
    assert told["wrong_at_80"] == pytest.approx(1 / 3)  # three of four are kept
    assert told["auroc_presence"] == pytest.approx(10 / 12)  # 0.2 is below 0.6 and 0.5
    assert sum(one["frames"] for one in told["bins"]) == 7
