"""Turn a page's content into one HTML file: style and images inside, no script, nothing fetched."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources

from jinja2 import Environment, PackageLoader, StrictUndefined

from posefilter.report.blocks import Block, Charts, Fold, Paragraph, Section, Table, Tile, make_slug


@dataclass(frozen=True)
class Page:
    """All that a page says."""

    title: str  # of the window
    heading: str  # what is read first
    lines: Sequence[Paragraph]  # below the heading
    tiles: Sequence[Tile]  # the main numbers
    notes: Sequence[str]  # what a reader should know before the rest, a sentence each
    sections: Sequence[Section]  # the rest; those without content are left out
    foot: Paragraph  # where the page is from

    def render(self) -> str:
        """Return the page as HTML.  Whatever its content holds is escaped."""
        sections = [
            Section(title, kept) for title, blocks in self.sections if (kept := drop_empty(blocks))
        ]
        file = resources.files("posefilter.report").joinpath("templates", "page.css")
        style = file.read_text(encoding="utf-8")
        template = open_templates().get_template("page.html")
        return template.render(page=self, sections=sections, style=style)

    def files(self) -> dict[str, bytes]:
        """Return the charts of the page as PNGs by file name."""
        return find_charts([block for section in self.sections for block in section.blocks])


def drop_empty(blocks: Sequence[Block]) -> list[Block]:
    """Return the blocks less the tables without rows."""
    return [block for block in blocks if not (isinstance(block, Table) and not block.rows)]


def find_charts(blocks: Sequence[Block]) -> dict[str, bytes]:
    """Return the charts among blocks, and within them, by file name."""
    out: dict[str, bytes] = {}
    for block in blocks:
        if isinstance(block, Charts):
            out |= {chart.file: chart.png for chart in block.charts}
        elif isinstance(block, Fold):
            out |= find_charts(block.blocks)
    return out


@cache
def open_templates() -> Environment:
    """Return the templates; they escape what they are given, and refuse what they are not."""
    loader = PackageLoader("posefilter.report", "templates")
    templates = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.filters |= {"slug": make_slug, "kind": lambda block: type(block).__name__}
    return templates
