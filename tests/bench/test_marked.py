"""Tables between marks: one takes the place of another, and the rest of the page stays."""

from collections.abc import Callable
from types import ModuleType

import pytest


@pytest.fixture
def marked(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("bench/marked.py")


PAGE = "a\n<!-- table: one -->\n<!-- end -->\nb\n<!-- table: two -->\n| old |\n<!-- end -->\nc\n"


def test_a_table_takes_the_place_of_the_one_before(marked: ModuleType) -> None:
    once = marked.put_table(PAGE, "two", ["x", "y"], [marked.format_row(["1", "2"])])
    table = "| x | y |\n| --- | --- |\n| 1 | 2 |"
    assert once == PAGE.replace("| old |", table)
    assert marked.put_table(once, "two", ["x", "y"], ["| 1 | 2 |"]) == once
    assert marked.put_table(once, "one", ["x", "y"], ["| 1 | 2 |"]).count(table) == 2


def test_rows_are_read_back_without_the_head(marked: ModuleType) -> None:
    rows = ["| 1 |", "| 2 |"]
    page = marked.put_table(PAGE, "one", ["x"], rows)
    assert marked.read_rows(page, "one") == rows
    assert marked.read_rows(PAGE, "one") == []
    blank = page.replace("| x |", "\n| x |").replace("| 2 |", "| 2 |\n")
    assert marked.read_rows(blank, "one") == rows


def test_a_page_without_both_marks_is_left_alone(marked: ModuleType) -> None:
    for page in (PAGE.replace("table: one", "table: other"), "<!-- table: one -->\n| x |\n"):
        with pytest.raises(ValueError, match="no <!-- table: one --> with an <!-- end --> after"):
            marked.put_table(page, "one", ["x"], [])
        with pytest.raises(ValueError, match="no <!-- table: one -->"):
            marked.read_rows(page, "one")
