"""Write the tables of results in docs/ from docs/results/runs.csv, which holds every run as a row.

    python bench/tables.py [--check]

A table stands between two comments of a page:

    <!-- runs table=ablation method=patch_pf changed=*ablation=c* show=on object %|offset cosine -->
    <!-- end -->

`table`, `method`, `variant` and `changed` choose rows; `changed` takes shell patterns, separated by
`|`. `show` lists the figures, `changed` and `variant` are left out where all rows agree. Runs that
differ in their seed alone become one row: the mean, and the sample standard deviation over seeds;
with `spread=interval` the 95 % confidence interval of the mean (Student's t) in its place.
`omit` leaves settings out of the column `changed` by shell patterns: those that a command above the
table has for all rows. Rows keep the order of the file. A table of more than ten rows is refused,
and one without runs, unless bench/methods.py plans it: then the page says that it is not made yet.
`--check` writes nothing, and fails where a page is not up to date.
"""

import csv
import re
import sys
from collections import defaultdict
from collections.abc import Iterable, Sequence
from fnmatch import fnmatch
from statistics import mean, stdev

from marked import format_table
from methods import plan
from programs import HOME, make_parser
from scipy.stats import t as student_t

RUNS = HOME / "docs" / "results" / "runs.csv"
MOST_ROWS = 10
PLANNED = {line.table for line in plan("DIR", "DIR")}
NOT_MADE = "*Not made yet.*"
INTERVAL = "interval"
MARK = re.compile(
    r"(?P<mark><!-- runs (?P<words>.*?) -->)\n(?P<body>.*?)(?P<end><!-- end -->)", re.DOTALL
)
Row = dict[str, str]
Key = tuple[str, str, str]


def parse_mark(words: str) -> dict[str, str]:
    """Return the settings of a mark by name.

    Raises:
        ValueError: A setting is unknown.
    """
    found = re.findall(r"(\w+)=(.*?)(?=\s+\w+=|$)", words.strip())
    settings = {name: value.strip() for name, value in found}
    known = {"table", "method", "variant", "changed", "show", "spread", "omit"}
    missing = not {"table", "show"} <= set(settings)
    if set(settings) - known or missing or settings.get("spread", INTERVAL) != INTERVAL:
        raise ValueError(f"a mark takes {', '.join(sorted(known))}, and not: {words}")
    return settings


def select_runs(rows: Iterable[Row], settings: dict[str, str]) -> list[Row]:
    """Return the runs that a mark asks for."""

    def fits(row: Row) -> bool:
        return all(
            any(fnmatch(row[name], pattern) for pattern in settings[name].split("|"))
            for name in ("table", "method", "variant", "changed")
            if name in settings
        )

    return [row for row in rows if fits(row)]


def format_cell(values: list[float], interval: bool = False) -> str:
    """Return the mean, and the sample standard deviation where there is more than one value; or
    the 95 % confidence interval of the mean.
    """
    if not values:
        return "–"
    middle = mean(values)
    digits = 1 if abs(middle) >= 5 else 2
    if interval and len(values) > 1:
        n = len(values)
        half = float(student_t.ppf(0.975, n - 1)) * stdev(values) / n**0.5
        return f"{middle:.{digits}f} [{middle - half:.{digits}f}, {middle + half:.{digits}f}]"
    spread = f" ± {stdev(values):.{digits}f}" if len(values) > 1 else ""
    return f"{middle:.{digits}f}{spread}"


def shorten(changed: str, omit: str) -> str:
    """Return what was changed without the settings that patterns, separated by `|`, leave out."""
    patterns = omit.split("|")
    kept = (w for w in changed.split() if not any(fnmatch(w, pattern) for pattern in patterns))
    return " ".join(kept)


def make_table(rows: list[Row], show: list[str], interval: bool = False, omit: str = "") -> str:
    """Return a Markdown table, one row for the runs that differ in their seed alone.

    Raises:
        ValueError: No run fits, a figure is unknown, or there are more than ten rows.
    """
    if not rows:
        raise ValueError("no run fits")
    unknown = [name for name in show if name not in rows[0]]
    if unknown:
        raise ValueError(f"there is no figure {', '.join(unknown)}")
    groups: dict[Key, list[Row]] = defaultdict(list)
    for row in rows:
        groups[row["method"], row["variant"], row["changed"]].append(row)
    if len(groups) > MOST_ROWS:
        raise ValueError(f"{len(groups)} rows, at most {MOST_ROWS}")
    columns: dict[str, list[str]] = {
        "method": [method for method, _, _ in groups],
        "variant": [variant for _, variant, _ in groups],
        "changed": [f"`{short}`" if (short := shorten(c, omit)) else "" for _, _, c in groups],
        "seeds": [str(len(runs)) for runs in groups.values()],
    }
    for name in show:
        columns[name] = [
            format_runs([run[name] for run in runs], interval) for runs in groups.values()
        ]
    for name in ("method", "variant", "changed"):
        if len(set(columns[name])) == 1 and (len(groups) > 1 or name != "method"):
            del columns[name]
    return format_table(list(columns), zip(*columns.values(), strict=True))


def format_runs(cells: Sequence[str], interval: bool) -> str:
    """Return the cell of some runs; with how many have the figure, where not all do."""
    known = [float(cell) for cell in cells if cell]
    count = f" ({len(known)})" if 0 < len(known) < len(cells) else ""
    return format_cell(known, interval) + count


def fill_page(text: str, rows: list[Row]) -> str:
    """Return a page with every table made anew."""

    def fill(found: re.Match[str]) -> str:
        try:
            settings = parse_mark(found["words"])
            runs = select_runs(rows, settings)
            show, omit = settings["show"].split("|"), settings.get("omit", "")
            waits = not runs and settings["table"] in PLANNED
            table = NOT_MADE if waits else make_table(runs, show, "spread" in settings, omit)
        except ValueError as error:
            raise ValueError(f"{found['mark']}: {error}") from error
        return f"{found['mark']}\n\n{table}\n\n{found['end']}"

    return MARK.sub(fill, text)


def main() -> int:
    """Fill the tables of every page; with --check, tell whether they are up to date."""
    parser = make_parser(__doc__)
    parser.add_argument("--check", action="store_true")
    check = parser.parse_args().check
    with RUNS.open() as file:
        rows = list(csv.DictReader(file))
    stale = []
    for page in sorted((HOME / "docs").rglob("*.md")):
        text = page.read_text()
        try:
            filled = fill_page(text, rows)
        except ValueError as error:
            print(f"{page.relative_to(HOME)}: {error}", file=sys.stderr)
            return 2
        if filled != text:
            stale.append(str(page.relative_to(HOME)))
            if not check:
                page.write_text(filled)
    if check and stale:
        print(f"not up to date: {', '.join(stale)}; python bench/tables.py", file=sys.stderr)
    return int(check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
