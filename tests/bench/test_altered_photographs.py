"""The bench of altered photographs: changes are exact, the same for all files, and rows stay."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from posefilter.data.frames import Sample


@pytest.fixture
def altered(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("bench/altered_photographs.py")


def make_sample(value: int) -> Sample:
    """Return a square of 60 pixels at 1 m before a wall at 2 m."""
    rgb = np.full((120, 160, 3), value, dtype=np.uint8)
    depth, mask = np.full((120, 160), 2.0, dtype=np.float32), np.zeros((120, 160), dtype=bool)
    mask[30:90, 50:110] = True
    depth[mask] = 1.0
    K = np.array([[160, 0, 79.5], [0, 160, 59.5], [0, 0, 1]], dtype=np.float32)
    pose = np.eye(4, dtype=np.float32)
    pose[2, 3] = 1.0
    return Sample(rgb, depth, mask, K, pose, 0, 0, 1.0)


def test_views_are_spread_over_each_sequence(altered: ModuleType) -> None:
    names = ["a"] * 8 + ["b"] * 4
    records = [SimpleNamespace(object=name, group="0001") for name in names]
    records += [SimpleNamespace(object="a", group="0002")] * 4
    assert altered.choose_views(records, "a") == [0, 2, 4, 6, 12, 13, 14, 15]
    assert altered.choose_views(records, "c") == []


@pytest.mark.parametrize("change", ["none", "roll", "far", "occluded", "color", "all"])
def test_a_change_keeps_the_pose_true(altered: ModuleType, change: str) -> None:
    """The object's center stays where the pose and the intrinsics put it."""
    views = [(make_sample(90), [make_sample(200)])]
    samples = altered.alter(views, change, 6)
    again = altered.alter(views, change, 6)
    for one, same in zip(samples, again, strict=True):
        assert np.array_equal(one.rgb, same.rgb)
        assert np.array_equal(one.depth, same.depth)
        if change in ("roll", "far", "none"):
            u, v = np.argwhere(one.mask).mean(0)[::-1]
            center = one.intrinsics @ one.camera_from_object[:3, 3]
            assert np.allclose((u, v), center[:2] / center[2], atol=1.0)
            assert np.median(one.depth[one.mask]) == pytest.approx(1.0)
    first = next((one for one in samples if one.mask.sum() < views[0][0].mask.sum()), samples[0])
    changed = {
        "rgb": not np.array_equal(first.rgb, views[0][0].rgb),
        "depth": not np.array_equal(first.depth, views[0][0].depth),
    }
    assert changed["depth"] == (change not in ("none", "color"))
    if change == "color":
        assert changed["rgb"]
    if change == "occluded":
        assert 0 < first.mask.sum() < views[0][0].mask.sum()
        hidden = views[0][0].mask & ~first.mask
        assert (first.depth[hidden] < 1.0).all()


def measure(sample: Sample) -> tuple[float, float, float]:
    """Return the share of pixels without depth, the median depth of the square, and its noise."""
    square = sample.depth[sample.mask & (sample.depth > 0) & (sample.depth < 1.5)]
    return float((sample.depth == 0).mean()), float(np.median(square)), float(square.std())


def test_other_sensors_change_what_they_say_of_the_depth_alone(altered: ModuleType) -> None:
    view = make_sample(90)
    for change in altered.SENSORS:
        one, *others = altered.alter([(view, [])], change, 8)
        again = altered.alter([(view, [])], change, 1)[0]
        assert np.array_equal(one.depth, again.depth)
        assert any(not np.array_equal(one.depth, other.depth) for other in others)
        assert one.rgb is view.rgb
        assert one.mask is view.mask
        assert one.depth.dtype == np.float32
        lost, median, noise = measure(one)
        if change.startswith("by 6"):
            moved = np.argwhere(one.depth == 1.0).mean(0) - np.argwhere(view.mask).mean(0)
            assert np.hypot(*moved) == pytest.approx(6, abs=1)
        elif change in ("off by 1 %", "by 2 %"):
            share = 0.01 if "1" in change else 0.02
            assert abs(median - 1) == pytest.approx(share, rel=1e-3)
        elif change == "half lost":
            assert lost == pytest.approx(0.5, abs=0.01)
        elif change == "of 10 mm":
            assert 0.005 < noise < 0.02
        elif change == "stereo":
            assert lost == pytest.approx(0.2, abs=0.01)
            near = (one.depth > 0) & (one.depth < 1.5)
            assert near[~view.mask].sum() > 200  # the square has grown


def test_unknown_depth_stays_unknown(altered: ModuleType) -> None:
    view = make_sample(90)
    view.depth[:40] = 0
    for change in ("off by 1 %", "waves of 4 mm", "half lost", "stereo"):
        (one,) = altered.alter([(view, [])], change, 1)
        assert not one.depth[:36].any()  # stereo: what is near grows by 3 pixels


def test_a_file_has_one_row_and_others_stay(altered: ModuleType, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    marks = "<!-- table: {} -->\n<!-- end -->\n"
    page.write_text(f"x\n{marks.format('altered')}y\n{marks.format('sensors')}")

    def row(name: str, change: str, area: float) -> dict[str, object]:
        return {
            "object": name,
            "weights": "w",
            "change": change,
            "images": 4,
            "add_auc": area,
            "add_s_auc": area + 1,
            "found_wrong": 1,
        }

    altered.write_table([row("b", "none", 50.0), row("b", "all", 40.0)], page)
    altered.write_table([row("a", "none", 60.0)], page)
    altered.write_table([row("b", "none", 70.0)], page)
    altered.write_table([row("a", "half lost", 30.0)], page)
    lines = [line for line in page.read_text().splitlines() if line.startswith(("| a", "| b"))]
    assert lines.pop() == "| a | w | – | – | – | – | 30.0 / 31.0 | – | – | – | 1 of 4 |"
    assert lines[0].startswith("| a | w | 60.0 / 61.0 | – |")
    assert lines[1].startswith("| b | w | 70.0 / 71.0 | – |")
    assert lines[1].endswith("| 1 of 4 |")
    assert len(lines) == 2


def test_a_change_that_was_tested_twice_counts_once(altered: ModuleType, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "<!-- table: altered -->\n<!-- end -->\n<!-- table: sensors -->\n<!-- end -->\n"
    )
    row = {"object": "a", "weights": "as it ships", "change": "none", "images": 4}
    old = row | {"add_auc": 50.0, "add_s_auc": 60.0, "found_wrong": 2}
    new = row | {"add_auc": 90.0, "add_s_auc": 95.0, "found_wrong": 1}
    altered.write_table([old, new], page)
    line = next(one for one in page.read_text().splitlines() if one.startswith("| a "))
    assert "90.0 / 95.0" in line
    assert line.endswith("| 1 of 4 |")
