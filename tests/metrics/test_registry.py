"""The registry of metrics: it knows every number that a run writes down, and writes each as it
should be read.
"""

import math
import re
from pathlib import Path

import pytest

from posefilter.errors import UserError
from posefilter.metrics.registry import HIGHER, LOWER, METRICS, find_metric, read_number, rename_key

HOME = Path(__file__).parents[2]


def test_keys_are_unique_and_labels_tell_metrics_of_a_table_apart() -> None:
    tables = [
        [key for key in METRICS if key.startswith(prefix)]
        for prefix in ("add", "belief/", "diagnostics/")
    ]
    for keys in tables:
        labels = [METRICS[key].title for key in keys]
        assert len(set(labels)) == len(labels)
    assert all(key == info.key for key, info in METRICS.items())


def test_a_number_is_written_in_its_unit() -> None:
    assert find_metric("particles_on_object").describe(0.5) == "50.0 %"
    assert find_metric("belief/spread_m").describe(0.0123) == "12.3 mm"
    assert find_metric("belief/spread_m").describe(1.0412) == "1.04 m"
    assert find_metric("belief/spread_m").split(0.9999) == ("999.9", "mm")
    assert find_metric("belief/spread_m").describe(math.inf) == "inf mm"
    assert find_metric("add/median_mm").title == "median ADD [mm]"
    assert find_metric("iou").describe(0.8766) == "0.877"
    assert find_metric("diagnostics/on_object/first").column == "on object at start %"


@pytest.mark.parametrize(
    ("key", "known"),
    [
        ("val/add/auc", "add/auc"),
        ("test/iou", "iou"),
        ("by_visibility/0.3-0.5/add_s/median_mm", "add_s/median_mm"),
        ("val/by_visibility/0-0.3/instances", "instances"),
        ("diagnostics/off_frame/last", "diagnostics/off_frame"),
        ("val/diagnostics/offset_cosine", "diagnostics/offset_cosine"),
        ("val/diagnostics/heading", "diagnostics/offset_cosine"),
        ("diagnostics/line_share/last", "diagnostics/first_axis_share"),
        ("filter/ess/step_03", "filter/ess"),
        ("val/belief/coverage_90", "belief/distance_coverage_90"),
        ("belief/coverage_50", "belief/distance_coverage_50"),
        ("val/apparent_size/ratio", "scale_ratio/ratio"),
    ],
)
def test_every_way_to_write_a_key_leads_to_its_metric(key: str, known: str) -> None:
    assert find_metric(key).key == known


def test_an_unknown_key_is_named() -> None:
    with pytest.raises(UserError, match="add/acu: there is no such metric"):
        find_metric("add/acu")


def test_numbers_are_read_where_they_are() -> None:
    metrics = {
        "add": {"auc": 71},
        "diagnostics": {"on_object": [0.1, 0.7]},
        "iou": float("nan"),
        "seed": True,
        "name": "x",
    }
    assert read_number(metrics, "add/auc") == 71.0
    assert read_number(metrics, "diagnostics/on_object/first") == 0.1
    assert read_number(metrics, "diagnostics/on_object/last") == 0.7
    for key in (
        "add/median_mm",
        "add_s/auc",
        "iou",
        "seed",
        "name",
        "diagnostics/on_object",
        "add",
    ):
        assert read_number(metrics, key) is None


def test_numbers_are_read_by_earlier_names() -> None:
    old, new = {"coverage_50": 48.0}, {"distance_coverage_50": 47.0}
    assert read_number({"belief": old}, "belief/distance_coverage_50") == 48.0
    assert read_number({"belief": old | new}, "belief/distance_coverage_50") == 47.0
    assert read_number({"belief": old}, "belief/distance_coverage_90") is None
    assert rename_key("val/belief/coverage_50") == "val/belief/distance_coverage_50"
    assert rename_key("credibility/coverage_50") == "credibility/coverage_50"
    assert rename_key("val/belief/distance_coverage_50") == "val/belief/distance_coverage_50"


def test_numbers_below_an_earlier_name_are_read_by_it() -> None:
    old, new = {"apparent_size": {"ratio": 1.25}}, {"scale_ratio": {"ratio": 0.8}}
    assert read_number(old, "scale_ratio/ratio") == 1.25
    assert read_number(old | new, "scale_ratio/ratio") == 0.8
    assert read_number(old, "scale_ratio/images") is None
    assert rename_key("val/apparent_size/images") == "val/scale_ratio/images"
    assert read_number({"diagnostics": {"heading": 0.5}}, "diagnostics/offset_cosine") == 0.5
    lines = {"diagnostics": {"line_share": [0.6, 0.9]}}
    assert read_number(lines, "diagnostics/first_axis_share/last") == 0.9
    assert rename_key("diagnostics/line_share/first") == "diagnostics/first_axis_share/first"
    assert rename_key("apparent_sizes/images") == "apparent_sizes/images"


def test_better_is_the_way_that_a_better_filter_goes() -> None:
    """An error, a time and what is lost should be small; a share that is found, an area and a score
    should be large.
    """
    for key, info in METRICS.items():
        if re.search(r"median|seconds|missed|off_frame|outscored", key):
            assert info.direction == LOWER, key
        if re.search(r"auc|recall|iou|on_object|mass|score$", key):
            assert info.direction == HIGHER, key


def test_documents_name_the_same_columns() -> None:
    """The tables of runs are asked for by the columns' names: each name that a document asks for is
    a metric's.
    """
    asked = {
        name.strip()
        for page in (HOME / "docs").rglob("*.md")
        for names in re.findall(r"<!-- table: \w+ \(([^)]*)\)", page.read_text())
        for name in names.split(",")
    }
    columns = {info.column for info in METRICS.values()} | {
        "loss jumps",
        "CPU min",
        "relative time",
    }
    assert asked <= columns
