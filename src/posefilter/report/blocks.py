"""What pages are made of: plain data, which the templates turn into HTML.

Nothing here is HTML, so nothing here needs escaping.
"""

import hashlib
from collections.abc import Sequence
from typing import Literal, NamedTuple

from posefilter.report.charts import DARK, LIGHT, WIDTH_PX, Panel, draw_chart, measure_height
from posefilter.report.images import WIDE_PX, StoredImage, encode_image, encode_png

_LONGEST = 160  # [bytes] of a chart's file name, less its suffix

Style = Literal["", "code", "soft", "good", "bad", "done", "badge"]


class Text(NamedTuple):
    """Words in a style."""

    text: str
    style: Style = ""


Cell = str | Text


class Heading(NamedTuple):
    """A heading within a section."""

    text: str


class Paragraph(NamedTuple):
    """A paragraph of words in several styles."""

    parts: Sequence[Cell]


class Table(NamedTuple):
    """A table, which scrolls within itself where it is too wide; without rows it is left out."""

    head: Sequence[str]  # the columns' names; no head where all are empty
    rows: Sequence[Sequence[Cell]]
    numeric: Sequence[int] = ()  # columns of numbers
    marked: int | None = None  # a row that stands out
    form: str = ""  # how it folds on a phone, or `narrow`; see page.css


class Fold(NamedTuple):
    """Blocks that open on demand."""

    title: str
    blocks: Sequence["Block"]


class Chart(NamedTuple):
    """A chart for light and for dark pages, as data URIs."""

    light: str
    dark: str
    width: int
    height: int
    words: str  # for those who do not see it
    file: str  # name of the light one's PNG
    png: bytes


class Charts(NamedTuple):
    """Charts side by side."""

    charts: Sequence[Chart]


class GalleryImage(NamedTuple):
    """An image in a page; `error` says what is wrong with one that cannot be shown."""

    caption: str
    source: str = ""
    width: int = 0
    height: int = 0
    error: str = ""

    @property
    def wide(self) -> bool:
        """Tell whether it is several images in a row, which a phone scrolls."""
        return self.width >= WIDE_PX


class Gallery(NamedTuple):
    """Images with their captions."""

    images: Sequence[GalleryImage]
    wide: bool = False


class Tile(NamedTuple):
    """A large number at the top of a page."""

    value: str
    unit: str
    label: str


Block = Heading | Paragraph | Table | Fold | Charts | Gallery


class Section(NamedTuple):
    """A part of a page with its own heading."""

    title: str
    blocks: Sequence[Block]


def draw_charts(panels: Sequence[Panel]) -> list[Charts]:
    """Return charts side by side, each drawn for light and for dark pages; nothing where there is
    none.
    """
    charts = []
    for panel in panels:
        light, dark = draw_chart(panel, LIGHT), draw_chart(panel, DARK)
        file = f"{name_chart(panel)}.png"
        height, words = measure_height(panel), describe_panel(panel)
        charts.append(
            Chart(encode_png(light), encode_png(dark), WIDTH_PX, height, words, file, light)
        )
    return [Charts(charts)] if charts else []


def show_images(images: Sequence[StoredImage], wide: bool = False) -> list[Gallery]:
    """Return a gallery; an image that cannot be read says so in its place."""
    out = []
    for image in images:
        try:
            source, width, height = encode_image(image.data)
            out.append(GalleryImage(image.caption, source, width, height))
        except ValueError as error:
            out.append(GalleryImage(image.name, error=str(error)))
    return [Gallery(out, wide)] if out else []


def describe_panel(panel: Panel) -> str:
    """Return a chart in words."""
    ends = "; ".join(f"{line.label} {line.y[-1]:.4g}" for line in panel.lines if len(line.y))
    return f"{panel.title} over {panel.xlabel}, at the end: {ends}"


def name_chart(panel: Panel) -> str:
    """Return a name for a chart's file, of a length that every file system takes."""
    slug = f"{make_slug(panel.title)}-{make_slug(panel.xlabel)}"
    if len(slug.encode()) <= _LONGEST:
        return slug
    return f"{slug[: _LONGEST // 4]}-{hashlib.sha256(slug.encode()).hexdigest()[:12]}"


def make_slug(name: str) -> str:
    """Return a name fit for an address within the page, and for a file."""
    return "-".join("".join(c if c.isalnum() else " " for c in name.lower()).split())
