"""Files of a run of somebody else: a page is made of them, or one line says what is wrong."""

import json
import os
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from torch.utils.tensorboard import SummaryWriter

from posefilter.errors import UserError
from posefilter.files import write_whole
from posefilter.metrics import image_errors
from posefilter.metrics.image_errors import ImageError
from posefilter.report.gather import read_run
from posefilter.report.run_page import make_run_page
from posefilter.report.settings import compare_settings
from posefilter.report.sweep_page import make_sweep_page
from posefilter.report.sweeps import parse_number, read_sweep

LEVELS = [0.5, 0.8, 0.9, 0.95]
QUARTER = {"from": 0.75, "to": 1.0, "instances": 3, "coverage": LEVELS}
BIN = {"from": 0.1, "to": 0.2, "frames": 4, "probability": 0.15, "right": 0.25}
Change = Callable[[dict[str, Any]], Any]


def add(**parts: Any) -> Change:
    return lambda metrics: {**metrics, **parts}


def change_numbers(value: Any) -> Change:
    def walk(node: Any) -> Any:
        if isinstance(node, dict):
            return {key: walk(one) for key, one in node.items()}
        if isinstance(node, list):
            return [walk(one) for one in node]
        return value if isinstance(node, int | float) else node

    return walk


def credible(**parts: Any) -> Change:
    whole = {"levels": LEVELS, "all": LEVELS, "quarters": [QUARTER]}
    return add(credibility={**whole, **parts})


REFUSED: dict[str, tuple[Change, str]] = {
    "NaN": (change_numbers(float("nan")), "the number NaN cannot be computed with"),
    "infinity": (change_numbers(float("-inf")), "the number -Infinity cannot"),
    "the end of numbers": (change_numbers(1e308), "the number 1e\\+308 cannot"),
    "a whole number of 400 digits": (change_numbers(10**400), "cannot be computed with"),
    "texts for numbers": (change_numbers("<b>"), "its instances should be a number, and is '<b>'"),
    "truths for numbers": (change_numbers(True), "its instances should be a number"),
    "lists for numbers": (change_numbers([]), "its instances should be a number"),
    "a range that is none": (add(by_visibility={"a": {"instances": 1}}), "as 0.3-0.5: a"),
    "a range of NaN": (add(by_visibility={"nan-1": {"instances": 1}}), "as 0.3-0.5: nan-1"),
    "a range without images": (add(by_visibility={"0-1": {}}), "its by_visibility.0-1 has no inst"),
    "ranges that are a list": (add(by_visibility=[1]), "its by_visibility should be a mapping"),
    "versions that are a text": (add(versions="x"), "its versions should be a mapping"),
    "data that are a number": (add(data=5), "its data should be a mapping"),
    "splits that are texts": (
        add(data={"splits": {"a": "b"}}),
        "its data.splits.a should be a map",
    ),
    "levels that are a number": (credible(levels=5), "its credibility.levels should be a list"),
    "fewer shares than levels": (credible(all=[1.0]), "should have a share for each"),
    "no shares": (credible(all=None), "should have a share for each"),
    "a quarter without an end": (
        credible(quarters=[{"from": 0.5}]),
        r"its credibility.quarters\[0\] has no to",
    ),
    "bins that are numbers": (add(confidence={"bins": [1]}), r"confidence.bins\[0\] should be a m"),
}
TAKEN: dict[str, Change] = {
    "credibility and confidence": lambda m: credible()(add(confidence={"bins": [BIN]})(m)),
    "other levels": credible(levels=[0.1], all=[0.2], quarters=[{**QUARTER, "coverage": [0.3]}]),
    "nulls": lambda m: dict.fromkeys(m),
    "nulls for lists": credible(levels=None, all=None, quarters=None),
    "a diagnostic that ends in null": add(
        diagnostics={"off_frame": [0.5, None], "offset_cosine": ["x"]}
    ),
    "negative numbers": change_numbers(-1),
    "zeros": change_numbers(0),
    "large numbers": change_numbers(1e30),
}


EVIL = (
    "\ud800\"><script>alert(1)</script><img src=x onerror=alert(1)>'$x^{\\frac{$ ../../up\x1b[2J"
    "\u202e{{7*7}}{%raw%}=1+1"
)


class Seen(HTMLParser):
    """What a browser would act on."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag in ("script", "iframe", "object", "embed", "form", "base", "link", "svg"):
            self.found.append(tag)
        for name, value in attrs:
            inner = (value or "").startswith(("#", "data:image/"))
            if name.startswith("on") or (name in ("src", "srcset", "href") and not inner):
                self.found.append(f"{tag} {name}={value}")


def spoil(value: Any) -> Any:
    """Return content with every text, and a name in each mapping, that does something."""
    if isinstance(value, dict):
        return {
            **{key: spoil(one) for key, one in value.items()},
            EVIL: EVIL,
            EVIL + "2": {EVIL: 1},
        }
    if isinstance(value, list):
        return [spoil(one) for one in value]
    return EVIL if isinstance(value, str) else value


def spoil_metrics(metrics: dict[str, Any]) -> dict[str, Any]:
    ranges = {name: spoil(one) for name, one in metrics.pop("by_visibility").items()}
    more = {"versions": {EVIL: EVIL}, "data": {"objects": [EVIL], "splits": {EVIL: {EVIL: 1}}}}
    return {**spoil(metrics), "by_visibility": ranges, "overrides": [f"a={EVIL}"], **more}


def test_names_of_a_run_do_nothing_in_its_page(run: Path) -> None:
    rewrite(run, spoil_metrics)
    (run / "metrics_train.json").write_bytes((run / "metrics.json").read_bytes())
    rows = [ImageError(1, 1, 1, EVIL[1:], EVIL[1:], 0.5, 9, 9, 9, 0.5, 0.5, 0.5)]
    image_errors.write_errors(run / "errors.csv", rows)
    with SummaryWriter(str(run)) as log:
        for tag in (
            f"val/{EVIL[1:]}",
            f"3_belief/{EVIL[1:]}",
            "../../up",
            "filter/ess/step_" + "9" * 5000,
        ):
            log.add_scalar(tag, 1.0, 5)
            log.add_image(tag, np.zeros((8, 8, 3), np.uint8), 5, dataformats="HWC")
    odd = [b"<script>", b"1\xc2\xb22", b"=1+1", b"\xff\x1b[2J"]
    for name in odd:
        place = os.fsencode(run / "figures") + b"/" + name + b".png"
        os.link(run / "figures" / "best_0.png", place)
    (run / "figures" / "x.png").write_bytes(b"<svg onload=alert(1)>")
    page = make_run_page(read_run(run), compare_settings({}, {}), "x")
    assert Seen(page.render()).found == []
    assert "&lt;script&gt;" in page.render()
    assert all(re.fullmatch(r"[\w.\-]+", name) for name in page.files())
    write_whole(run / "report" / "report.html", page.render())


def test_names_of_a_sweep_do_nothing_in_its_page(sweep: Path) -> None:
    for file in sweep.rglob("metrics.json"):
        metrics = json.loads(file.read_text())
        kept = [one for one in metrics["overrides"] if not one.startswith(("out", "refine"))]
        setting = f"refine={EVIL}{file.parent.name}"
        file.write_text(json.dumps({**spoil_metrics(metrics), "overrides": [*kept, setting]}))
    folder = next(path for path in sorted(sweep.iterdir()) if path.is_dir())
    folder.rename(sweep / os.fsdecode(b"\xff\x1b[2J"))
    page = make_sweep_page(read_sweep(sweep), None, None, "x")
    assert Seen(page.render()).found == []
    assert all(re.fullmatch(r"[\w.\-]+", name) for name in page.files())


def make_page(folder: Path) -> dict[str, str]:
    """Return the page of a run as report.py makes it."""
    record = read_run(folder)
    page = make_run_page(record, compare_settings(record.config, {}), "x")
    page.files()
    return {"": page.render()}


def rewrite(run: Path, change: Change) -> None:
    file = run / "metrics.json"
    file.write_text(json.dumps(change(json.loads(file.read_text()))))


@pytest.mark.parametrize("what", REFUSED)
def test_metrics_that_no_page_can_be_made_of(what: str, run: Path) -> None:
    change, told = REFUSED[what]
    rewrite(run, change)
    with pytest.raises(UserError, match=told) as caught:
        make_page(run)
    assert "metrics.json" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("what", TAKEN)
def test_odd_metrics_of_which_one_can(what: str, run: Path) -> None:
    rewrite(run, TAKEN[what])
    make_page(run)


OTHERS = {
    "objects that are a number": ("data.json", '{"objects": 5}', "its objects should be a list"),
    "objects without names": (
        "data.json",
        '{"objects": [1]}',
        r"its objects\[0\] should be a text",
    ),
    "a trainer that is a number": (".hydra/config.yaml", "trainer: 5", "its trainer should be a m"),
    "data that are a list": (".hydra/config.yaml", "data: [1]", "its data should be a mapping"),
}


@pytest.mark.parametrize("what", OTHERS)
def test_other_files_that_no_page_can_be_made_of(what: str, run: Path) -> None:
    name, content, told = OTHERS[what]
    (run / name).write_text(content)
    with pytest.raises(UserError, match=told) as caught:
        make_page(run)
    assert str(run / name) in str(caught.value)


def test_settings_that_are_days_and_sets(run: Path) -> None:
    (run / ".hydra" / "config.yaml").write_text("a: 2001-01-01\nb: !!set {x}\nc: !!binary eA==")
    assert "2001-01-01" in make_page(run)[""]


def write_errors(run: Path, number: str) -> None:
    whole = ("scene_id", "im_id", "obj_id", "object", "image")
    rows = [
        ",".join(str(i) if name in whole else number for name in ImageError._fields)
        for i in range(20)
    ]
    (run / "errors.csv").write_text("\n".join([",".join(ImageError._fields), *rows]))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("number", ["nan", "inf", "-inf", "1e30", "-1", "0"])
@pytest.mark.slow
def test_errors_of_images_that_are_no_lengths(number: str, run: Path) -> None:
    write_errors(run, number)
    make_page(run)


def test_errors_of_images_that_are_too_large(run: Path) -> None:
    write_errors(run, "1e308")
    with pytest.raises(
        UserError, match=r"errors\.csv: .*visibility=1e\+308 cannot be computed with"
    ):
        make_page(run)


def test_numbers_of_a_sweep_that_are_too_large_are_words(tmp_path: Path) -> None:
    for text in ("nan", "-inf", "1e999", "9" * 400):
        assert parse_number(text) == text
    assert (parse_number("5"), parse_number("0.5"), parse_number(str(2**63))) == (5, 0.5, 2**63)
    (tmp_path / "summary.csv").write_text(f"folder,a,add_auc\nx,{'9' * 400},nan\ny,1,5\n")
    jobs = read_sweep(tmp_path).jobs
    assert [job.numbers for job in jobs] == [{"add/auc": 5.0}, {}]
