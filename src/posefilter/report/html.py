"""The page: plain HTML with its style and pictures inside, no script, nothing fetched."""

from base64 import b64encode
from collections.abc import Sequence
from html import escape
from importlib import resources

from posefilter.report.charts import DARK, LIGHT, WIDTH_PX, Panel, draw_chart, measure_height
from posefilter.report.images import SHEET_PX, StoredImage, encode_image

Parts = list[tuple[str, str]]  # title and content of each section


def page(title: str, head: str, sections: Parts, foot: str) -> str:
    """Return the whole page; sections without content are left out.  All but `title` are HTML."""
    kept = [(name, content) for name, content in sections if content]
    links = "".join(f'<a href="#{slug(name)}">{escape(name)}</a>' for name, _ in kept)
    body = "".join(f'<section id="{slug(name)}"><h2>{escape(name)}</h2>{content}</section>\n' for name, content in kept)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{escape(title)}</title>
<style>{style()}</style>
</head>
<body>
<header>{head}</header>
<nav>{links}</nav>
<main>
{body}</main>
<footer>{foot}</footer>
</body>
</html>
"""


def style() -> str:
    """Return the page's style figure."""
    return resources.files("posefilter.report").joinpath("page.css").read_text()


def slug(name: str) -> str:
    """Return a name fit for an address within the page."""
    return "-".join("".join(c if c.isalnum() else " " for c in name.lower()).split())


def tiles(entries: Sequence[tuple[str, str, str]]) -> str:
    """Return large figures: value, unit, label."""
    cells = "".join(
        f'<div class="tile"><b>{escape(value)}<i>{escape(unit)}</i></b><span>{escape(label)}</span></div>'
        for value, unit, label in entries
    )
    return f'<div class="tiles">{cells}</div>' if cells else ""


def table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    numeric: Sequence[int] = (),
    marked: int | None = None,
    kind: str = "",
) -> str:
    """Return a table that scrolls within itself where it is too wide.  Cells are HTML.

    numeric: columns of numbers; marked: a row that stands out; kind: how it folds on a phone, or `narrow`, see page.css.
    """
    if not rows:
        return ""

    def cells(row: Sequence[str], tag: str) -> str:
        kinds = [' class="n"' if i in numeric else "" for i in range(len(row))]
        return "".join(f"<{tag}{kind}>{cell}</{tag}>" for kind, cell in zip(kinds, row, strict=True))

    marks = [' class="marked"' if i == marked else "" for i in range(len(rows))]
    top = f"<thead><tr>{cells(head, 'th')}</tr></thead>" if any(head) else ""
    body = "".join(f"<tr{mark}>{cells(row, 'td')}</tr>" for mark, row in zip(marks, rows, strict=True))
    return f'<div class="scroll {kind}"><table>{top}<tbody>{body}</tbody></table></div>'


def charts(panels: Sequence[Panel]) -> tuple[str, dict[str, bytes]]:
    """Return charts side by side, each for light and dark, and the light ones as PNGs by file name."""
    out, files = [], {}
    for panel in panels:
        light, dark = draw_chart(panel, LIGHT), draw_chart(panel, DARK)
        files[f"{slug(panel.title)}-{slug(panel.xlabel)}.png"] = light
        out.append(
            f'<picture class="chart"><source media="(prefers-color-scheme: dark)" srcset="{uri(dark)}">'
            f'<img src="{uri(light)}" width="{WIDTH_PX}" height="{measure_height(panel)}" '
            f'alt="{escape(describe(panel))}"></picture>'
        )
    return (f'<div class="charts">{"".join(out)}</div>' if out else ""), files


def describe(panel: Panel) -> str:
    """Return a chart in words, for those who do not see it."""
    ends = "; ".join(f"{line.label} {line.y[-1]:.4g}" for line in panel.lines if len(line.y))
    return f"{panel.title} over {panel.xlabel}, at the end: {ends}"


def uri(png: bytes) -> str:
    """Return a PNG as a data URI."""
    return "data:image/png;base64," + b64encode(png).decode()


def gallery(pictures: Sequence[StoredImage], wide: bool = False) -> str:
    """Return pictures with their captions; one that cannot be read says so in its place."""
    out = []
    for picture in pictures:
        try:
            source, width, height = encode_image(picture.data)
        except ValueError as error:
            out.append(f'<figure><p class="gone">{escape(picture.name)}: {escape(str(error))}</p></figure>')
            continue
        caption = escape(picture.caption)
        kind = ' class="figure"' if width >= SHEET_PX else ""
        shown = f'<img src="{source}" width="{width}" height="{height}" alt="{caption}">'
        out.append(f'<figure{kind}><div class="scroll">{shown}</div><figcaption>{caption}</figcaption></figure>')
    kind = "gallery wide" if wide else "gallery"
    return f'<div class="{kind}">{"".join(out)}</div>' if out else ""


def notes(sentences: Sequence[str]) -> str:
    """Return what a reader should know first."""
    items = "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences)
    return f'<ul class="notes">{items}</ul>' if items else ""


def fold(title: str, content: str) -> str:
    """Return content that opens on demand."""
    return f"<details><summary>{escape(title)}</summary>{content}</details>" if content else ""


def code(text: str) -> str:
    """Return something that was typed, or is a name."""
    return f"<code>{escape(text)}</code>"
