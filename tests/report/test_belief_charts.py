"""The report shows whether a belief means what it says: what is drawn is what was counted."""

from typing import Any

import pytest
import torch

from posefilter.metrics.confidence import Confidence
from posefilter.metrics.credibility import LEVELS, Credibility, TruthScores
from posefilter.report.beliefs import chart_coverage, chart_reliability, show_calibration
from posefilter.report.blocks import Table


def make_metrics(count: int = 400) -> dict[str, Any]:
    """Return numbers of beliefs that are right where much is seen, and too sure elsewhere."""
    g = torch.Generator().manual_seed(0)
    rank, visible = torch.rand(2, count, generator=g, dtype=torch.float64)
    rank = torch.where(visible < 0.5, rank**0.3, rank)
    metric, told = Credibility(), Confidence()
    metric.update(TruthScores(rank, rank, rank), visible)
    probability = torch.rand(count, generator=g, dtype=torch.float64)
    right = torch.rand(count, generator=g, dtype=torch.float64) < probability
    every = torch.ones(count, dtype=torch.bool)
    told.update(probability, probability, every, right, torch.zeros(count))
    return {"instances": count, "credibility": metric.compute(), "confidence": told.compute()}


def test_curves_start_and_end_at_the_corners_and_lie_where_the_beliefs_do() -> None:
    (panel,) = chart_coverage(make_metrics())
    assert [line.label for line in panel.lines] == [
        "all",
        "visible share 0 to 0.25",
        "visible share 0.25 to 0.5",
        "visible share 0.5 to 0.75",
        "visible share 0.75 to 1",
    ]
    for line in panel.lines:
        assert (line.x[0], line.y[0], line.x[-1], line.y[-1]) == (0, 0, 100, 100)
        assert list(line.y) == sorted(line.y)
    middle = [line.y[1 + LEVELS.index(0.5)] for line in panel.lines]
    assert max(middle[1:3]) < 25 < 35 < min(middle[3:]) < max(middle[3:]) < 65


def test_reliability_lies_on_the_diagonal_where_labels_are_drawn_from_probabilities() -> None:
    (panel,) = chart_reliability(make_metrics())
    (line,) = panel.lines
    assert len(line.x) == 10
    assert max(abs(x - y) for x, y in zip(line.x, line.y, strict=True)) < 25
    assert panel.diagonal == (0, 100)


def test_tables_count_every_image_once_and_what_is_missing_is_left_out() -> None:
    metrics = make_metrics()
    coverage, reliability = (b for b in show_calibration(metrics) if isinstance(b, Table))
    counts = [int(str(row[1])) for row in coverage.rows]
    assert counts[0] == sum(counts[1:]) == 400
    share = 100 * metrics["credibility"]["all"][LEVELS.index(0.9)]
    assert float(str(coverage.rows[0][4])) == pytest.approx(share, abs=0.5)
    assert sum(int(str(row[1])) for row in reliability.rows) == 400
    assert show_calibration({}) == []
    assert show_calibration({"credibility": None, "confidence": None}) == []
    only = show_calibration({**metrics, "confidence": None})
    assert sum(isinstance(b, Table) for b in only) == 1
