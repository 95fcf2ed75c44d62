"""Markdown's tables, and those of a page in docs/, between the marks `<!-- table: TITLE -->` and
`<!-- end -->`.
"""

from collections.abc import Iterable, Sequence

MARK, END = "<!-- table: {} -->", "<!-- end -->"


def format_row(cells: Iterable[object]) -> str:
    """Return a line of a table."""
    return f"| {' | '.join(map(str, cells))} |"


def format_table(head: Sequence[object], rows: Iterable[Iterable[object]]) -> str:
    """Return a table of cells."""
    return "\n".join(map(format_row, [head, ["---"] * len(head), *rows]))


def split_row(row: str) -> list[str]:
    """Return the cells of a line of a table."""
    return row.strip("| ").split(" | ")


def read_rows(page: str, title: str) -> list[str]:
    """Return the lines of a table without its head, as they stand in the page.

    Raises:
        ValueError: The page has no such marks.
    """
    lines = [line for line in _split(page, title)[1].splitlines() if line.strip()]
    return lines[2:]


def put_table(page: str, title: str, head: Sequence[str], rows: Iterable[str]) -> str:
    """Return a page with a table in place of what is between its marks.

    Args:
        page: The text of the page.
        title: The table's, as its mark has it.
        head: The headings of the columns.
        rows: Lines, see `format_row`.

    Raises:
        ValueError: The page has no such marks.
    """
    before, _, after = _split(page, title)
    return before + "\n".join([MARK.format(title), format_table(head, ()), *rows, END]) + after


def _split(page: str, title: str) -> tuple[str, str, str]:
    before, mark, rest = page.partition(MARK.format(title))
    old, end, after = rest.partition(END)
    if not mark or not end:
        raise ValueError(f"the page has no {MARK.format(title)} with an {END} after it")
    return before, old, after
