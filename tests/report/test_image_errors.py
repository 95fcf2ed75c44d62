"""Errors image by image: their distribution, how they grow with occlusion, and two runs on the same
images.
"""

import json
import math
import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from posefilter.errors import UserError
from posefilter.metrics.image_errors import FILE, ImageError, write_errors
from posefilter.metrics.scores import auc
from posefilter.report.blocks import Paragraph, Section, Table, Text
from posefilter.report.comparison_page import (
    judge,
    list_settings,
    list_verdict,
    make_comparison_page,
    match_images,
    read_two_runs,
    tabulate_common,
)
from posefilter.report.gather import read_run
from posefilter.report.image_errors import (
    chart_errors,
    compute_cdf,
    group_by_visibility,
    list_worst,
)
from posefilter.report.page import Page
from posefilter.report.run_page import make_run_page


def make_row(number: int, error: float, visibility: float = 1.0) -> ImageError:
    """Return an image of an object of 200 mm."""
    name = f"scene/{number:06d}"
    return ImageError(0, number, 1, "box", name, visibility, error, error / 2, 200.0, 1.0, 0.0, 0.1)


def make_rows(seed: int, count: int = 64, offset: float = 0.0) -> list[ImageError]:
    g = np.random.default_rng(seed)
    errors = g.exponential(10.0, count) + offset
    return [
        make_row(i, float(e), float(v))
        for i, (e, v) in enumerate(zip(errors, g.uniform(0.2, 1, count), strict=True))
    ]


def test_a_cdf_never_falls_and_ends_at_the_share_within_the_limit() -> None:
    g = np.random.default_rng(0)
    for count in (1, 2, 77):
        errors = [*g.exponential(60.0, count).tolist(), math.inf]
        x, y = compute_cdf(errors)
        assert (np.diff(x) >= 0).all()
        assert (np.diff(y) >= 0).all()
        assert (x[0], y[0], x[-1]) == (0.0, 0.0, 100.0)
        assert y[-1] == pytest.approx(100 * np.mean(np.array(errors) < 100))
        for threshold in (5.0, 20.0, 99.0):  # at any threshold it is what one counts
            at = max(i for i in range(len(x)) if x[i] <= threshold)
            assert y[at] == pytest.approx(100 * np.mean(np.array(errors) <= threshold))


def test_the_area_under_the_cdf_is_about_the_auc() -> None:
    """The published AUC is a sum of steps of the right end: with many images it is the area."""
    rows = make_rows(1, 2000)
    x, y = compute_cdf([row.add_mm for row in rows])
    published = auc(torch.tensor([row.add_mm for row in rows], dtype=torch.float64) / 1000)
    assert np.trapezoid(y, x) / 100 == pytest.approx(published, abs=0.1)


def test_ranges_of_visibility_hold_each_image_once_and_in_order() -> None:
    rows = [*make_rows(2, 50), make_row(99, 1.0, math.nan)]
    parts = group_by_visibility(rows)
    assert sorted(row.im_id for part in parts for row in part) == list(range(50))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    for before, after in pairwise(parts):
        assert max(row.visibility for row in before) <= min(row.visibility for row in after)
    assert group_by_visibility(rows[:10]) == []  # too few to tell apart
    whole = [make_row(number, 1.0, min(1.0, 0.5 + number / 60)) for number in range(60)]
    *below, last = group_by_visibility(whole)  # 30 of them show the whole object
    assert sorted(row.im_id for part in [*below, last] for row in part) == list(range(60))
    assert sum(row.visibility == 1 for row in last) == 30
    assert {len(part) for part in below} <= {8, 9}
    assert group_by_visibility([make_row(number, 1.0) for number in range(60)]) == []
    (curve,) = (
        panel for panel in chart_errors({"": rows}) if panel.title.startswith("ADD < 0.1 diameter")
    )
    means = np.array(curve.lines[0].y)
    assert np.average(means, weights=[len(part) for part in parts]) == pytest.approx(
        100 * np.mean([row.add_mm < 0.1 * row.diameter_mm for row in rows[:50]])
    )


def test_the_run_page_shows_them(run: Path) -> None:
    write_errors(run / FILE, [*make_rows(3, 20), make_row(20, 1234.0), make_row(21, math.inf)])
    page = make_run_page(read_run(run), None, "x")
    text, files = page.render(), page.files()
    assert "images-with-an-error-below-a-threshold-threshold-mm.png" in files
    assert "add-auc-by-visibility-visible-share.png" in files
    assert text.index("scene/000021") < text.index("scene/000020") < text.index("1.23 m")
    assert ">missed<" in text
    assert "No errors.csv" not in text
    (run / FILE).write_text("a,b\n1,2\n")
    with pytest.raises(
        UserError,
        match=r"errors\.csv: is no table of errors \(column scene_id is "
        r"missing\)",
    ):
        read_run(run)


def test_ranges_that_share_images_are_apart(run: Path) -> None:
    """Rows of one table add up to the images in it; those from a share upwards have a table of
    their own.
    """
    metrics = json.loads((run / "metrics.json").read_text())
    own = metrics["by_visibility"].pop("0.3-0.5")
    counts = {"0-0.3": 1, "0.3-0.5": 2, "0.5-0.8": 3, "0.8-1": 4, "0.5-1": 7, "0.6-1": 5}
    metrics["by_visibility"] = {name: own | {"instances": count} for name, count in counts.items()}
    (run / "metrics.json").write_text(json.dumps(metrics))
    page = make_run_page(read_run(run), None, "x")
    (blocks,) = [section.blocks for section in page.sections if section.title == "Results"]
    apart, above = [b for b in blocks if isinstance(b, Table)][1:3]
    assert [row[:2] for row in apart.rows] == [
        ["0 to 0.3", "1"],
        ["0.3 to 0.5", "2"],
        ["0.5 to 0.8", "3"],
        ["0.8 to 1", "4"],
    ]
    assert [row[:2] for row in above.rows] == [["at least 0.5", "7"], ["at least 0.6", "5"]]


@pytest.fixture
def pair(run: Path, tmp_path: Path) -> tuple[Path, Path]:
    """Return two runs: the second is 1 mm worse in every image, and was tested on fewer."""
    other = tmp_path / "other,with=a comma"
    shutil.copytree(run, other)
    rows = make_rows(4, 40)
    write_errors(run / FILE, rows)
    write_errors(other / FILE, [row._replace(add_mm=row.add_mm + 1) for row in rows[5:]][::-1])
    return run, other


def test_images_are_matched_by_name_not_by_index(pair: tuple[Path, Path]) -> None:
    a, b = read_two_runs(f"{pair[0]},{pair[1]}")
    assert (a.folder, b.folder) == pair
    pairs = match_images(a.errors, b.errors)
    assert len(pairs) == 35
    assert [one.change for one in pairs] == pytest.approx([1.0] * 35)
    verdict = judge(pairs)
    assert (verdict.a, verdict.b, verdict.equal) == (35, 0, 0)
    assert verdict.chance == pytest.approx(2 / 2**35)


def test_images_of_one_name_that_show_other_things_are_no_pair() -> None:
    """Rendered sets name their images alike."""
    row = make_row(0, 3.0)
    assert match_images([row], [row._replace(visibility=0.95)])  # of another resolution
    assert match_images([row], [row._replace(visibility=math.nan)])
    assert not match_images([row], [row._replace(visibility=0.8)])
    assert not match_images([row], [row._replace(diameter_mm=210.0)])
    detected = row._replace(add_mm=math.nan, diameter_mm=math.nan)  # of a method without poses
    assert match_images([detected], [detected])
    assert match_images([row], [detected])


def test_instances_of_an_image_are_paired_in_their_order() -> None:
    two = [make_row(0, 3.0), make_row(0, 50.0)]
    assert [(pair.a.add_mm, pair.b.add_mm) for pair in match_images(two, two)] == [
        (3.0, 3.0),
        (50.0, 50.0),
    ]
    assert judge(match_images(two, two))[:3] == (0, 0, 2)
    # one test left an instance out, and nothing tells which
    assert match_images([*two, make_row(1, 2.0)], [two[1], make_row(1, 4.0)]) == [
        (make_row(1, 2.0), make_row(1, 4.0))
    ]


def test_a_median_that_is_infinite_is_not_like_one_that_is_not() -> None:
    half = [make_row(k, math.inf if k < 6 else 3.0) for k in range(10)]
    found = [make_row(k, 3.0) for k in range(10)]
    better, worse = ("missed", "3.0 mm", Text("better", "good")), ("3.0 mm", "missed")
    for rows, cells in (
        ({"A": half, "B": found}, better),
        ({"A": found, "B": half}, (*worse, Text("worse", "bad"))),
    ):
        (own,) = (row for row in tabulate_common(rows).rows if row[0] == "median ADD")
        assert (*own[1:],) == cells
    cells = {row[0]: row[3] for row in tabulate_common({"A": half, "B": half}).rows}
    assert cells["median ADD"] == "alike"


def test_images_that_one_run_missed_count_in_the_median_change() -> None:
    """The others alone would have the other sign."""
    first = [make_row(i, 5.0) for i in range(10)]

    def compare(missed: int, others: float = 4.0) -> str:
        second = [make_row(i, math.inf if i < missed else others) for i in range(10)]
        return str(list_verdict(match_images(first, second), ("A", "B"))[0])

    assert "from the first to the second is -1 mm." in compare(4)
    assert "no median change: B alone misses half of the images or more." in compare(5)
    assert "no median change: B alone misses half of the images or more." in compare(7)
    second = [make_row(i, math.inf if i < 3 else 5.0 + i / 10) for i in range(10)]
    said = str(list_verdict(match_images(first, second), ("A", "B"))[0])
    assert "from the first to the second is +0.75 mm." in said
    back = str(list_verdict(match_images(second[:3], first[:3]), ("A", "B"))[0])
    assert "no median change: A alone misses" in back


def test_a_comparison_turned_round_is_the_same(pair: tuple[Path, Path]) -> None:
    a, b = read_two_runs(f"{pair[0]},{pair[1]}")
    forth, back = judge(match_images(a.errors, b.errors)), judge(match_images(b.errors, a.errors))
    assert (forth.a, forth.b, forth.equal, forth.chance) == (
        back.b,
        back.a,
        back.equal,
        back.chance,
    )
    alike = judge(match_images(a.errors, a.errors))
    assert (alike.a, alike.b, alike.chance) == (0, 0, 1.0)


def test_a_run_against_itself_differs_in_nothing_and_noise_by_chance() -> None:
    both = match_images(make_rows(5), make_rows(6))
    assert judge(both).chance > 0.05
    missed = match_images([make_row(0, math.inf)], [make_row(0, math.inf)])
    assert judge(missed)[:3] == (0, 0, 1)


def test_a_turn_that_is_a_symmetry_decides_nothing() -> None:
    """By ADD, the first would be far ahead."""
    first = [make_row(i, 5.0)._replace(add_up_to_symmetry_mm=5.0) for i in range(20)]
    turned = [make_row(i, 90.0)._replace(add_up_to_symmetry_mm=4.0) for i in range(20)]
    both = match_images(first, turned)
    assert judge(both)[:3] == (0, 20, 0)
    assert "by ADD up to symmetry" in str(list_verdict(both, ("A", "B")))
    rows = {"A": first, "B": turned}
    table = {row[0]: row[1:] for row in tabulate_common(rows).rows}
    assert next(iter(table)) == "ADD up to symmetry AUC"
    assert table["median ADD up to symmetry"] == ["5.0 mm", "4.0 mm", Text("-1.0 mm", "good")]
    cdf = chart_errors(rows)[0]
    assert cdf.xlabel == "threshold of the ADD up to symmetry [mm]"
    assert [line.y[-1] for line in cdf.lines] == [100.0, 100.0]
    assert max(cdf.lines[1].x[:-1]) == 4.0
    hidden = [row._replace(visibility=0.5 + i / 40) for i, row in enumerate(turned)]
    own, auc, recall = chart_errors({"": hidden})
    assert [line.label for line in own.lines] == ["ADD up to symmetry", "ADD", "ADD-S"]
    assert auc.title == "ADD up to symmetry AUC by visibility"
    assert set(recall.lines[0].y) == {100.0}
    earlier = match_images([make_row(i, 5.0) for i in range(20)], turned)
    assert judge(earlier)[:3] == (20, 0, 0)
    assert "by ADD:" in str(list_verdict(earlier, ("A", "B")))


def test_the_comparison_page(pair: tuple[Path, Path]) -> None:
    a, b = read_two_runs(f"{pair[0]},{pair[1]}")
    page = make_comparison_page(a, b, "x")
    text = page.render()
    assert "35" in text
    assert "+1.0 mm" in text  # of the median
    assert "5 images of run &lt;1&gt; are not in the other test" in text
    assert "Where run &lt;1&gt; is most ahead" in text
    assert "Where other" not in text
    assert {"images-with-an-error-below-a-threshold-threshold-mm.png"} <= set(page.files())


def test_what_cannot_be_compared_is_refused(pair: tuple[Path, Path], tmp_path: Path) -> None:
    a, b = read_two_runs(f"{pair[0]},{pair[1]}")
    with pytest.raises(UserError, match="should be the folders of two runs"):
        read_two_runs(str(pair[0]))
    write_errors(pair[1] / FILE, [make_row(1000, 1.0)])
    with pytest.raises(UserError, match="no common image"):
        make_comparison_page(a, read_run(pair[1]), "x")
    write_errors(pair[1] / FILE, [row._replace(add_mm=math.nan) for row in a.errors])
    with pytest.raises(UserError, match="one of the two only detects, or both"):
        make_comparison_page(a, read_run(pair[1]), "x")
    (pair[1] / FILE).unlink()
    with pytest.raises(UserError, match=r"has no errors\.csv"):
        read_two_runs(f"{pair[0]},{pair[1]}")
    assert b.errors


def test_of_two_evaluations_what_was_typed_is_compared(pair: tuple[Path, Path]) -> None:
    """They have no configuration of their own."""
    for folder, particles in zip(pair, (20, 50), strict=True):
        metrics = json.loads((folder / "metrics.json").read_text())
        typed = [f"++filter.particles={particles}", "data.limit_test=4"]
        metrics |= {"overrides": typed, "checkpoint": "a.ckpt"}
        (folder / "metrics.json").write_text(json.dumps(metrics))
        shutil.rmtree(folder / ".hydra", ignore_errors=True)
    a, b = read_two_runs(f"{pair[0]},{pair[1]}")
    (note, table) = list_settings(a, b, ("A", "B"))
    assert [[str(cell) for cell in row] for row in table.rows] == [
        [str(Text(cell, "code")) for cell in ("filter.particles", "20", "50")]
    ]
    assert "what was typed" in str(note)
    assert a.missing[0].startswith("An evaluation")


def test_the_worst_of_a_symmetric_object_are_those_that_are_wrong_up_to_symmetry() -> None:
    rows = [make_row(i, 150.0)._replace(add_up_to_symmetry_mm=1.0) for i in range(3)]
    rows.append(make_row(9, 40.0)._replace(add_up_to_symmetry_mm=40.0))
    text = Page("x", "x", [], [], [], [Section("x", list_worst(rows))], Paragraph([])).render()
    assert "ADD up to symmetry" in text
    assert text.index("000009") < text.index("000000")
    plain = list_worst([make_row(i, 5.0) for i in range(3)])
    assert "symmetry" not in str(plain)
