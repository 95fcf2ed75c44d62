"""The page holds what it should, holds all of it itself, and shows in a real browser."""

import re
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from jinja2 import Environment
from PIL import Image
from tests.report.browser import CHROMIUM, browser
from tests.report.conftest import MARK

from posefilter.cli import run_command
from posefilter.report.blocks import Paragraph, Section, Text, Tile, show_images
from posefilter.report.charts import DARK, LIGHT, Line, Panel, draw_chart, smooth
from posefilter.report.gather import read_run
from posefilter.report.images import StoredImage
from posefilter.report.page import Page
from posefilter.report.run_page import make_run_page
from posefilter.report.settings import Change
from posefilter.report.sweep_page import make_sweep_page
from posefilter.report.sweeps import read_sweep

HOME = Path(__file__).parents[2]
needs_browser = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium is installed (apt-get install chromium)"
)


class Outside(HTMLParser):
    """Collects what a page would fetch, and how many pictures it holds."""

    def __init__(self) -> None:
        super().__init__()
        self.fetched: list[str] = []
        self.pictures = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Take in one element."""
        self.pictures += tag == "img"
        for name, value in attrs:
            if name in ("src", "srcset", "href", "data", "poster") and not (value or "").startswith(
                ("data:", "#")
            ):
                self.fetched.append(f"{tag} {name}={value}")
        if tag in ("script", "link", "iframe", "object"):
            self.fetched.append(tag)


def outside(page: str) -> Outside:
    """Return what a page would fetch."""
    parser = Outside()
    parser.feed(page)
    return parser


def test_the_page_has_the_run_s_numbers(run: Path) -> None:
    """Figures, signs, settings, by their values; names are escaped; nothing is fetched."""
    content = make_run_page(
        read_run(run), [Change("filter.particles", "400", "9")], "python report.py run=x"
    )
    page, files = content.render(), content.files()
    for text in (
        "87.5",
        "ADD AUC",
        "0.3 to 0.5",
        "33.2",
        "All particles move in one direction",
        "4.2 mm",
        "contrast",
        "48 %",
    ):
        assert text in page, text
    row = re.search(r"<tr><td><code>filter.particles</code></td>.*?</tr>", page)
    assert row
    assert row[0].index("9") < row[0].index("400")
    assert "run &lt;1&gt;" in page
    assert "<1>" not in page
    parts = outside(page)
    assert parts.fetched == []
    assert parts.pictures == 5 + len(files)  # four files, one logged picture, and the charts
    assert {
        "training-loss-training-step.png",
        "relative-effective-sample-size-iteration.png",
    } <= set(files)
    assert outside('<img src="https://x.y/z.png"><script></script>').fetched  # the check can fail


def test_a_bare_run_still_has_a_page(tmp_path: Path) -> None:
    """Only metrics.json: the page says what is missing."""
    (tmp_path / "metrics.json").write_text(
        '{"instances": 2, "missed": 0, "add": null, "iou": 0.25, "particles_on_object": 0.5}'
    )
    content = make_run_page(read_run(tmp_path), None, "x")
    page, files = content.render(), content.files()
    assert "0.250" in page
    assert "No TensorBoard events" in page
    assert "No pictures" in page
    assert files == {}
    assert "ADD AUC" not in page


def test_a_broken_picture_is_named() -> None:
    """It does not end the report."""
    section = Section("Images", show_images([StoredImage("worst_3", "worst 3", b"nothing")]))
    page = Page("t", "h", [], [], [], [section], Paragraph(["x"])).render()
    assert re.search(r'<p class="gone">worst_3: [^<]+</p>', page)


HOSTILE = "<script>alert(1)</script>\"'&"


def test_a_hostile_name_is_only_words(run: Path) -> None:
    """Wherever a name, a setting or a caption goes on a page, it is escaped: no element comes of
    it.
    """
    there = run.rename(run.parent / HOSTILE.replace("/", "|"))
    (there / "metrics.json").write_text(
        (there / "metrics.json").read_text().replace("contrast", "<script>loss")
    )
    page = make_run_page(read_run(there), [Change(HOSTILE, HOSTILE, HOSTILE)], HOSTILE).render()
    assert outside(page).fetched == []
    assert "<script>" not in page
    assert page.count("&lt;script&gt;") >= 6
    blocks = [
        Paragraph([HOSTILE, Text(HOSTILE, "code")]),
        *show_images([StoredImage(HOSTILE, HOSTILE, b"")]),
    ]
    built = Page(
        HOSTILE,
        HOSTILE,
        [],
        [Tile(HOSTILE, HOSTILE, HOSTILE)],
        [HOSTILE],
        [Section("s", blocks)],
        Paragraph([HOSTILE]),
    )
    text = built.render()
    assert "<script>" not in text
    assert text.count("&lt;script&gt;") == 10
    assert "<script>" in Environment(autoescape=False).from_string("{{ name }}").render(
        name=HOSTILE
    )  # the check can fail


def test_charts_have_both_themes() -> None:
    """The same chart on light and dark paper, at twice the size it is shown."""
    panel = Panel(
        "Loss", "step", "mm", [Line("a", [0, 1, 2], [3, 2, 1]), Line("b", [0, 1, 2], [1, 2, 3])]
    )
    for theme in (LIGHT, DARK):
        image = np.asarray(Image.open(BytesIO(draw_chart(panel, theme))).convert("RGB"))
        assert image.shape == (500, 760, 3)
        paper = [int(theme.paper[i : i + 2], 16) for i in (1, 3, 5)]
        assert (np.abs(image[3, 3].astype(int) - paper) < 6).all()
        ink = [int(theme.lines[0][i : i + 2], 16) for i in (1, 3, 5)]
        assert (np.abs(image.astype(int) - ink).max(2) < 24).sum() > 200


def test_smoothing_keeps_lines_and_skips_gaps() -> None:
    """A straight line stays one, but for its end, which lags; what is not finite does not count."""
    line = np.linspace(2, 9, 100)
    assert np.allclose(smooth(line)[:-4], line[:-4])
    assert smooth(line)[-1] == pytest.approx(line[-5:].mean())
    line[50] = np.nan
    assert np.isfinite(smooth(line)).all()


def close_to(picture: np.ndarray, color: tuple[int, int, int]) -> int:
    """Return how many pixels are about of a color."""
    return int((np.abs(picture.astype(int) - color).max(2) < 12).sum())


@needs_browser
@pytest.mark.slow
def test_a_browser_shows_it(run: Path, sweep: Path, tmp_path: Path) -> None:
    """On a desk and on a phone, light and dark: no complaint, every picture there, nothing wider
    than the window.
    """
    text = make_run_page(read_run(run), [Change("a.long.key." * 9, "1", "x" * 150)], "x").render()
    (tmp_path / "run.html").write_text(text)
    best = read_run(sweep / "filter.particles=1000,refine=gradient,seed=2")
    (tmp_path / "sweep.html").write_text(make_sweep_page(read_sweep(sweep), best, [], "x").render())
    with browser(tmp_path / "profile") as page:
        for name in ("run", "sweep"):
            pictures = (tmp_path / f"{name}.html").read_text().count("<img")
            assert pictures >= 5
            for width, dark in ((1200, False), (390, True), (390, False)):
                page.open(
                    (tmp_path / f"{name}.html").as_uri(), width, dark=dark, phone=width == 390
                )
                assert page.complaints == []
                assert page.evaluate("innerWidth") == width
                assert page.evaluate("document.documentElement.scrollWidth") <= width, (name, width)
                assert (
                    page.evaluate("[...document.images].filter(i => i.naturalWidth > 0).length")
                    == pictures
                )
                shot = page.picture()
                assert (shot[5, 5].max() < 40) if dark else (shot[5, 5].min() > 230)
                assert (np.median(shot) < 60) == dark  # the charts too
                assert (close_to(shot, MARK) > 30_000) == (name == "run")  # the gallery


@needs_browser
@pytest.mark.slow
def test_the_browser_notices(run: Path, tmp_path: Path) -> None:
    """A script that is refused, a broken picture and a line too wide are each seen: the test above
    can fail.
    """
    text = make_run_page(read_run(run), [], "x").render()
    bad = (
        '<img src="data:image/png;base64,AAAA"><div style="width:700px">x</div>'
        "<script>1</script></body>"
    )
    (tmp_path / "bad.html").write_text(text.replace("</body>", bad))
    with browser(tmp_path / "profile") as page:
        page.open((tmp_path / "bad.html").as_uri(), 390, phone=False)
        assert any("Content Security Policy" in said for said in page.complaints)
        assert page.evaluate("[...document.images].filter(i => !i.naturalWidth).length") == 1
        assert page.evaluate("document.documentElement.scrollWidth") > 390


@pytest.mark.slow
def test_the_command(
    run: Path,
    sweep: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """`report.py` writes the page beside the run; a mistake is one line, and leaves nothing
    behind.
    """
    monkeypatch.chdir(run.parent)
    assert run_command("report", HOME, [f"run={run}"]) == 0
    page = (run / "report" / "report.html").read_text()
    assert "filter.particles" in page
    assert "differ from the defaults" in page  # the defaults were composed
    assert (run / "report" / "training-loss-training-step.png").is_file()
    capfd.readouterr()
    assert run_command("report", HOME, ["run=missing"]) == 2
    assert capfd.readouterr().err.strip() == "report: run=missing: no such folder"
    assert not (run.parent / "missing").exists()
    there = sweep.rename(sweep.parent / "a=1,b=2")  # as the folders of a sweep's runs are named
    typed = [f"sweep={there}", f"out={there / 'elsewhere'}"]
    assert run_command("report", HOME, typed) == 0
    assert "Sweep over filter.particles (2)" in (there / "elsewhere" / "report.html").read_text()


@pytest.mark.slow
def test_the_sweep_page(sweep: Path) -> None:
    """Means over seeds, the best marked, what is unfinished named; nothing is fetched."""
    found = read_sweep(sweep)
    best = read_run(sweep / "filter.particles=1000,refine=gradient,seed=2")
    content = make_sweep_page(found, best, [], "x")
    page, files = content.render(), content.files()
    marked = re.search(r'<tr class="marked">.*?</tr>', page)
    assert marked
    assert "80.3 ± 2.5" in marked[0]
    assert "Without a result: filter.particles=1000,refine=none,seed=2" in page
    assert "78.0 to 83.0 (sd 2.5)" in page
    assert outside(page).fetched == []
    assert {
        "add-auc-filter-particles.png",
        "add-auc-refine.png",
        "add-auc-time-per-image-s.png",
    } <= set(files)
