"""Tables of results: what a mark asks for is what the runs say."""

import csv
import sys
from collections.abc import Callable
from pathlib import Path
from statistics import fmean, stdev
from types import ModuleType

import pytest
from scipy.stats import t as student_t

HOME = Path(__file__).parents[2]


@pytest.fixture
def tables(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """Return the script."""
    return load_script("bench/tables.py")


def make_row(changed: str = "", seed: int = 0, **figures: float) -> dict[str, str]:
    row = {"table": "t", "method": "m", "variant": "paper", "changed": changed, "seed": str(seed)}
    return row | {"auc": "", "iou": ""} | {name: str(value) for name, value in figures.items()}


def test_seeds_become_one_row_with_their_standard_deviation(tables: ModuleType) -> None:
    values = [10.0, 12.0, 17.0]
    rows = [make_row(seed=seed, auc=value) for seed, value in enumerate(values)]
    table = tables.make_table([*rows, make_row("x=1", auc=3.0)], ["auc", "iou"])
    _, _, mean, single = table.splitlines()
    assert f"13.0 ± {stdev(values):.1f}" in mean
    assert mean.split("|")[2].strip() == "3"
    assert "3.00" in single
    assert "±" not in single
    assert single.endswith("– |")


def test_a_figure_that_some_seeds_lack_says_how_many_have_it(tables: ModuleType) -> None:
    rows = [make_row(seed=seed, auc=value) for seed, value in enumerate([10.0, 12.0, 17.0])]
    rows[1]["auc"] = ""
    *_, row = tables.make_table(rows, ["auc"]).splitlines()
    assert row.split("|")[-2].strip() == "13.5 ± 4.9 (2)"


def test_an_interval_covers_the_mean_as_students_t_says(tables: ModuleType) -> None:
    rows = [make_row(seed=seed, auc=value) for seed, value in enumerate([10.0, 12.0, 17.0])]
    page = "<!-- runs table=t show=auc spread=interval -->\n<!-- end -->"
    # t with two degrees of freedom: 4.303
    half = 4.303 * stdev([10.0, 12.0, 17.0]) / 3**0.5
    assert f"| 13.0 [{13 - half:.1f}, {13 + half:.1f}] |" in tables.fill_page(page, rows)
    assert "| 10.0 |" in tables.fill_page(page, rows[:1])


def test_settings_of_all_rows_can_be_left_out(tables: ModuleType) -> None:
    rows = [make_row(f"lr=0 steps=2 unit={unit}", auc=1.0) for unit in ("1", "10")]
    page = tables.fill_page("<!-- runs table=t show=auc omit=lr=*|steps=* -->\n<!-- end -->", rows)
    assert [line.split("|")[1].strip() for line in page.splitlines()[4:6]] == [
        "`unit=1`",
        "`unit=10`",
    ]
    assert "lr=0" not in page.replace("<!-- runs table=t show=auc omit=lr=*|steps=* -->", "")


def test_patterns_choose_rows(tables: ModuleType) -> None:
    rows = [
        make_row(f"ablation={name}", auc=1.0) for name in ("c1_a", "c10_b", "pose_c11_c", "m1_d")
    ]
    found = tables.select_runs(rows, {"table": "t", "changed": "*=c*|*=m*"})
    assert [row["changed"] for row in found] == ["ablation=c1_a", "ablation=c10_b", "ablation=m1_d"]


@pytest.mark.parametrize(
    ("mark", "words"),
    [
        ("table=none show=auc", "no run fits"),
        ("table=t show=speed", "no figure speed"),
        ("table=t show=auc", "11 rows"),
        ("table=t color=red show=auc", "a mark takes"),
        ("table=t", "a mark takes"),
        ("table=t show=auc spread=range", "a mark takes"),
    ],
)
def test_what_cannot_be_shown_is_refused(tables: ModuleType, mark: str, words: str) -> None:
    rows = [make_row(f"x={i}", auc=1.0) for i in range(11)]
    with pytest.raises(ValueError, match=words):
        tables.fill_page(f"<!-- runs {mark} -->\n<!-- end -->", rows)


def test_what_is_planned_and_not_made_is_said_to_be_so(
    tables: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = "<!-- runs table=later show=auc -->\n<!-- end -->"
    with pytest.raises(ValueError, match="no run fits"):
        tables.fill_page(page, [make_row(auc=1.0)])
    monkeypatch.setattr(tables, "PLANNED", {"later"})
    assert "Not made yet" in tables.fill_page(page, [make_row(auc=1.0)])
    made = {**make_row(auc=1.0), "table": "later"}
    assert "Not made yet" not in tables.fill_page(page, [made])


def test_a_page_filled_twice_stays_as_it_is(tables: ModuleType) -> None:
    page = "a\n\n<!-- runs table=t show=auc -->\nold\n<!-- end -->\n\nb\n"
    once = tables.fill_page(page, [make_row(auc=5.0)])
    assert "old" not in once
    assert "5.0" in once
    assert tables.fill_page(once, [make_row(auc=5.0)]) == once


def test_every_table_of_the_documents_is_what_the_runs_say(tables: ModuleType) -> None:
    with (HOME / "docs" / "results" / "runs.csv").open() as file:
        rows = list(csv.DictReader(file))
    pages = [page for page in (HOME / "docs").rglob("*.md") if "<!-- runs " in page.read_text()]
    assert len(pages) >= 3
    for page in pages:
        assert tables.fill_page(page.read_text(), rows) == page.read_text(), page


def measure_change(row: dict[str, str], figure: str) -> float:
    return float(row[f"{figure} %"]) - float(row[f"{figure} at start %"])


@pytest.mark.parametrize(
    ("table", "method", "unit", "figure", "sign", "said"),
    [
        ("unit_untrained", "patch_pf", "10", "on object", -1, "{} at 10 pixels and"),
        ("unit_untrained", "patch_pf", "1", "on object", -1, "{} at 1 pixel (five seeds each)"),
        ("unit_untrained", "patch_pf", "half_frame", "first-axis share", 1, "{} at half a frame"),
        ("unit_untrained", "patch_pf", "10", "first-axis share", 1, "{} at 10 pixels and 22"),
        ("unit_untrained", "patch_pf", "1", "first-axis share", 1, "{} at 1 (five seeds)"),
        ("unit_full", "patch_pf", "1", "on object", -1, "by seed {} are lost"),
        (
            "unit_full",
            "cnn_patch",
            "1",
            "on object",
            1,
            "| `cnn_patch`, gain over the start | {} |",
        ),
        ("unit_full", "cnn_patch", "10", "on object", 1, "| {} | 44 [25, 63] | -10"),
        (
            "unit_full",
            "downsized",
            "1",
            "on object",
            1,
            "| `downsized`, gain over the start | {} | 74",
        ),
        ("memorize", "pixel_pf", None, "on object", 1, "The gain is {}, that of"),
    ],
)
def test_intervals_in_the_text_are_of_the_runs_that_there_are(
    table: str, method: str, unit: str | None, figure: str, sign: int, said: str
) -> None:
    """More seeds change the tables by a command, and the sentences about them by hand."""
    with (HOME / "docs" / "results" / "runs.csv").open() as file:
        own = [r for r in csv.DictReader(file) if (r["table"], r["method"]) == (table, method)]
    chosen = [r for r in own if r["variant"] == "paper"]
    if unit is not None:
        chosen = [r for r in own if f"model.displacement.unit={unit}" in r["changed"].split()]
    changes = [sign * measure_change(row, figure) for row in chosen]
    half = student_t.ppf(0.975, len(changes) - 1) * stdev(changes) / len(changes) ** 0.5
    ends = (fmean(changes) - half, fmean(changes) + half)
    low, high = (f"{end:.0f}" if abs(end) >= 0.5 else f"{end:.1f}" for end in ends)
    page = (HOME / "docs" / "analysis" / "failures.md").read_text().replace(" points", "")
    assert said.format(f"{fmean(changes):.0f} [{low}, {high}]") in page


def test_a_stale_page_fails_the_check(
    tables: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "docs" / "results"
    folder.mkdir(parents=True)
    runs = folder / "runs.csv"
    runs.write_text("table,method,variant,changed,auc,seed\nt,m,paper,,7,0\n")
    page = folder / "page.md"
    page.write_text("<!-- runs table=t show=auc -->\n<!-- end -->\n")
    monkeypatch.setattr(tables, "HOME", tmp_path)
    monkeypatch.setattr(tables, "RUNS", runs)
    monkeypatch.setattr(sys, "argv", ["tables.py", "--check"])
    assert tables.main() == 1
    monkeypatch.setattr(sys, "argv", ["tables.py"])
    assert tables.main() == 0
    assert "7.0" in page.read_text()
    monkeypatch.setattr(sys, "argv", ["tables.py", "--check"])
    assert tables.main() == 0
