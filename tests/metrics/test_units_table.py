"""The table of units in the glossary says of each figure what the registry says."""

import re
from pathlib import Path

import pytest

from posefilter.metrics.registry import _METRICS, PERCENT, MetricInfo

GLOSSARY = Path(__file__).parents[2] / "docs" / "glossary.md"
LOGGED_ALONE = ("score", "best_score", "missed_fraction", "val_score_drop", "not_finite")
STORED = [
    info
    for info in _METRICS
    if info.key.split("/")[0] not in ("filter", "train", *LOGGED_ALONE)
    and info.key.split("/")[-1] not in ("first", "last")  # ends of lists
]
UNITS = {"particles": "count", "degrees": "rad"}


def read_rows() -> dict[str, str]:
    text = GLOSSARY.read_text().split("### Units of `metrics.json`")[1].split("\n\n`by_vis")[0]
    return dict(re.findall(r"^\| (\w+).*?\| (.*) \|$", text, re.MULTILINE))


def expect(info: MetricInfo) -> set[str]:
    """Return the rows that a figure may stand in."""
    if info.limits == PERCENT:
        return {"percent" if info.factor == 1 else "fraction"}
    if info.key.endswith("spread_m"):
        return {"m"}
    return {UNITS.get(info.unit, info.unit)} if info.unit else {"number", "count"}


@pytest.mark.parametrize("info", STORED, ids=lambda info: info.key)
def test_a_figure_is_listed_with_the_unit_that_it_is_stored_in(info: MetricInfo) -> None:
    key = info.key
    if "median" not in key:
        key = re.sub("^add_(s|up_to_symmetry)/", "add/", key)
    key = re.sub(r"credibility/coverage_\d+", "credibility/coverage_50", key)
    listed = {unit for unit, keys in read_rows().items() if f"`{key}`" in keys}
    assert len(listed) == 1
    assert listed <= expect(info)
