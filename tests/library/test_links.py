"""Links and commands of the documents name what there is, and their tables are tables."""

import re
from pathlib import Path

import pytest

HOME = Path(__file__).parents[2]
DOCS = HOME / "docs"
_PAGES = [
    *(HOME / name for name in ("README.md", "CONTRIBUTING.md", "weights/README.md")),
    *(one for one in sorted(DOCS.rglob("*.md")) if "scenes" not in one.parts),
]


def list_anchors(page: Path) -> set[str]:
    """Return what a link to a page may name: its headings, as GitHub and MkDocs write them."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    headings = (re.sub(r"\]\([^)]*\)", "", one) for one in re.findall(r"^#+ (.+)$", text, re.M))
    return {re.sub(r"[^\w -]", "", one).strip().lower().replace(" ", "-") for one in headings}


@pytest.mark.parametrize("page", _PAGES, ids=lambda page: str(page.relative_to(HOME)))
def test_every_link_leads_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for place, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)#?([^)\s]*)\)", text):
        target = (page.parent / place).resolve() if place else page
        assert target.exists(), f"{place}: no such file"
        if DOCS in page.parents:  # the site has nothing else
            assert DOCS in target.parents, f"{place}: is not on the site"
        if anchor:
            assert anchor in list_anchors(target), f"{place}#{anchor}: no such heading"


@pytest.mark.parametrize("page", _PAGES, ids=lambda page: str(page.relative_to(HOME)))
def test_every_command_names_what_there_is(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    named = re.findall(
        r"(?:\bpython |--config-dir |PYTHONPATH=)((?:bench|conf|docs|examples|tests)/[\w./-]*)",
        text,
    )
    named += re.findall(r"\bpython (\w+\.py)\b", text)
    for path in named:
        assert (HOME / path).exists(), f"{path}: no such file"


@pytest.mark.parametrize("page", _PAGES, ids=lambda page: str(page.relative_to(HOME)))
def test_tables_and_lists_are_shown_as_such(page: Path) -> None:
    """A table has a row of dashes below its head, and a list goes on after an empty line."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for head, below in re.findall(r"^(?<!\|\n)(\|.*)\n(.*)", text, re.M):
        assert re.fullmatch(r"\|[ :|-]+\|", below), f"{head}: no row of dashes below"
    for item in re.findall(r"^ {4}.*\n(- .*)", text, re.M):
        raise AssertionError(f"{item}: no empty line above")
