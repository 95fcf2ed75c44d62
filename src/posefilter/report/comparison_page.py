"""Compare two runs on the images that both were tested on."""

import math
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from statistics import median_high, median_low
from typing import Any, NamedTuple

from posefilter.errors import UserError
from posefilter.figures.layout import format_length
from posefilter.metrics.image_errors import FILE, ImageError, summarize_images
from posefilter.metrics.registry import find_metric
from posefilter.report.blocks import (
    Block,
    Cell,
    Heading,
    Paragraph,
    Section,
    Style,
    Table,
    Text,
    Tile,
    draw_charts,
)
from posefilter.report.charts import Line, Panel
from posefilter.report.gather import Run, read_run
from posefilter.report.image_errors import EQUAL_MM, chart_errors, has_symmetries
from posefilter.report.page import Page
from posefilter.report.result_tables import compare_numbers
from posefilter.report.run_page import list_changes
from posefilter.report.settings import compare_settings, read_typed

LISTED = 10  # images in a table of the greatest changes


class Pair(NamedTuple):
    """One image in two tests."""

    a: ImageError
    b: ImageError

    @property
    def errors(self) -> tuple[float, float]:
        """Return both errors [mm]: ADD up to symmetry, which is ADD where an object has none; ADD
        where a test of an earlier version has no other.
        """
        both = self.a.add_up_to_symmetry_mm, self.b.add_up_to_symmetry_mm
        return (self.a.add_mm, self.b.add_mm) if any(map(math.isnan, both)) else both

    @property
    def change(self) -> float:
        """Return how much greater the second error is [mm]; 0 where both missed the object."""
        first, second = self.errors
        return 0.0 if first == second else second - first


class Verdict(NamedTuple):
    """How often each of two runs is nearer to the truth."""

    a: int  # images in which the first is
    b: int
    equal: int
    # that runs which are equally good would differ as much in either direction (sign test)
    chance: float


def read_two_runs(text: str) -> tuple[Run, Run]:
    """Read `runs=A,B`: the folders may have commas in their names themselves.

    Raises:
        UserError: Where these are not two runs' folders, or one has no errors.csv.
    """
    parts = text.split(",")
    splits = [
        (",".join(parts[:i]).strip(), ",".join(parts[i:]).strip()) for i in range(1, len(parts))
    ]
    found = [(Path(a), Path(b)) for a, b in splits if Path(a).is_dir() and Path(b).is_dir()]
    if len(found) != 1:
        raise UserError(f"runs={text}: should be the folders of two runs, separated by a comma")
    a, b = (read_run(folder) for folder in found[0])
    for run in (a, b):
        if not run.errors:
            raise UserError(
                f"runs: {run.folder} has no {FILE}; test its checkpoint again with evaluate.py"
            )
    return a, b


def match_images(a: Sequence[ImageError], b: Sequence[ImageError]) -> list[Pair]:
    """Return the images that two tests share, by dataset name and ids, in the first one's order.

    Rendered sets name their images alike: an object of another diameter, or of which another share
    is visible, is in another image.

    Of several instances in an image the first are a pair, the second, and so on: a dataset always
    lists them in the same order. Where the tests have not as many of them, none is a pair.
    """
    own, others = (_group_by_identity(rows) for rows in (a, b))
    return [
        Pair(*both)
        for key, rows in own.items()
        if len(rows) == len(others.get(key, ()))
        for both in zip(rows, others[key], strict=True)
        if _shows_the_same(*both)
    ]


def _shows_the_same(a: ImageError, b: ImageError) -> bool:
    """Tell whether two rows of one name may be of one image, as far as both say."""
    unknown = math.isnan(a.diameter_mm) or math.isnan(b.diameter_mm)  # to detectors
    alike = unknown or math.isclose(a.diameter_mm, b.diameter_mm, rel_tol=1e-3)
    known = not math.isnan(a.visibility) and not math.isnan(b.visibility)
    # of another resolution of the same image it may differ a little
    return alike and not (known and abs(a.visibility - b.visibility) > 0.1)


def _group_by_identity(rows: Sequence[ImageError]) -> dict[tuple[Any, ...], list[ImageError]]:
    out: dict[tuple[Any, ...], list[ImageError]] = {}
    for row in rows:
        key = (row.image, row.scene_id, row.im_id, row.obj_id, row.object)
        out.setdefault(key, []).append(row)
    return out


def judge(pairs: Sequence[Pair]) -> Verdict:
    """Count in which images each of two runs is better, and tell whether that may be chance.

    The chance is that of the two-sided sign test: images that are alike do not count.
    """
    a, b = (sum(sign * pair.change > EQUAL_MM for pair in pairs) for sign in (1, -1))
    n, least = a + b, min(a, b)
    tail = sum(math.comb(n, k) for k in range(least + 1)) / 2**n if n else 1.0
    return Verdict(a, b, len(pairs) - a - b, min(1.0, 2 * tail))


def make_comparison_page(a: Run, b: Run, command: str) -> Page:
    """Return what the page about two runs says.

    Raises:
        UserError: Where their tests share no image, or one of them tells no pose.
    """
    pairs = match_images(a.errors, b.errors)
    if not pairs:
        raise UserError(f"runs: {a.folder} and {b.folder} were tested on no common image")
    if any(math.isnan(row.add_mm) for pair in pairs for row in pair):
        raise UserError(
            "runs: one of the two only detects, or both; errors are compared of two that estimate "
            "poses"
        )
    names = name_runs(a, b)
    rows = dict(zip(names, ([pair.a for pair in pairs], [pair.b for pair in pairs]), strict=True))
    charts = [*chart_errors(rows), *chart_pairs(pairs, names)]
    sections = [
        Section("Verdict", list_verdict(pairs, names)),
        Section("On the common images", [tabulate_common(rows), *draw_charts(charts)]),
        Section("Greatest changes", list_changes_of_images(pairs, names)),
        Section(
            "Whole tests", [compare_numbers(dict(zip(names, (a.metrics, b.metrics), strict=True)))]
        ),
        Section("Settings that differ", list_settings(a, b, names)),
    ]
    lines, notes = list[Paragraph](), list[str]()
    for name, run in zip(names, (a, b), strict=True):
        what = f"{run.named('model')}, {run.named('variant')}"
        lines.append(Paragraph([Text(name, "badge"), Text(str(run.folder), "code"), what]))
        left = len(run.errors) - len(pairs)
        if left > 0:
            notes.append(f"{left} images of {name} are not in the other test; they are left out.")
    title = f"{names[0]} against {names[1]}"
    foot = Paragraph(["Made with", Text(command, "code")])
    return Page(title, title, lines, make_tiles(pairs, names), notes, sections, foot)


def name_runs(a: Run, b: Run) -> tuple[str, str]:
    """Return short names that tell two runs apart: the last parts of their folders' names."""
    parts = a.folder.resolve().parts, b.folder.resolve().parts
    for depth in range(1, max(map(len, parts)) + 1):
        names = tuple("/".join(own[-depth:]) for own in parts)
        if names[0] != names[1]:
            return names[0], names[1]
    return "A", "B"


def make_tiles(pairs: Sequence[Pair], names: tuple[str, str]) -> list[Tile]:
    """Return the main numbers."""
    verdict = judge(pairs)
    nearer = [
        Tile(str(count), "", f"{name} is nearer")
        for count, name in zip(verdict[:2], names, strict=True)
    ]
    both, alike = Tile(str(len(pairs)), "", "common images"), Tile(str(verdict.equal), "", "alike")
    return [both, *nearer, alike]


def list_verdict(pairs: Sequence[Pair], names: tuple[str, str]) -> list[Block]:
    """Return in words which run is better, and how sure that is."""
    verdict = judge(pairs)
    chance = f"p = {verdict.chance:.2g}" if verdict.chance >= 1e-4 else "p < 0.0001"
    if verdict.chance < 0.05:
        better = names[0] if verdict.a > verdict.b else names[1]
        words: list[Cell] = [
            Text(better, "good"),
            f"is nearer to the truth in more images than chance would have it ({chance}).",
        ]
    else:
        words = [Text("No difference that chance would not explain", "soft"), f"({chance})."]
    how = (
        f"Sign test over images, by {name_error(pairs)}: those whose errors differ by less than "
        "0.05 mm do not count."
    )
    return [
        Paragraph([*words, describe_median_change(pairs, names)]),
        Paragraph([Text(how, "soft")]),
    ]


def describe_median_change(pairs: Sequence[Pair], names: tuple[str, str]) -> str:
    """Return the median change of the error in words; an image that one of two missed has an
    infinite change.
    """
    changes = [pair.change for pair in pairs]
    low, high = median_low(changes), median_high(changes)
    if math.isfinite(low) and math.isfinite(high):
        change = f"{(low + high) / 2:+.2g} mm"
        return f"The median change of the error from the first to the second is {change}."
    missing = [name for name, end in zip(names, (low, high), strict=True) if math.isinf(end)]
    if low == high:
        missing = [names[0] if low < 0 else names[1]]
    alone = " and as often ".join(f"{name} alone" for name in missing)
    return f"The error has no median change: {alone} misses half of the images or more."


def tabulate_common(rows: dict[str, list[ImageError]]) -> Table:
    """Return the metrics of both runs on the common images, and their difference."""
    symmetric = has_symmetries([row for own in rows.values() for row in own])
    found = [summarize_images(own, symmetric) for own in rows.values()]
    kinds = ("add_up_to_symmetry", "add", "add_s") if symmetric else ("add", "add_s")
    cells: list[list[Cell]] = []
    for kind, name in product(kinds, found[0]["add"]):
        info = find_metric(f"{kind}/{name}")
        first, second = (one[kind][name] for one in found)
        change = 0.0 if first == second else second - first  # both may be infinite
        difference: Cell = "alike"
        if f"{abs(change):.1f}" != "0.0":
            style: Style = "good" if change * info.direction > 0 else "bad"
            words = f"{change:+.1f} {info.unit}".strip()
            if math.isinf(change):  # half of the images or more are missed
                words = "better" if style == "good" else "worse"
            difference = Text(words, style)
        both = ("missed" if math.isinf(x) else info.describe(x) for x in (first, second))
        cells.append([info.label, *both, difference])
    return Table(("", *rows, "change"), cells, numeric=(1, 2, 3), form="narrow")


def name_error(pairs: Sequence[Pair]) -> str:
    """Return what the error of images is that are compared."""
    symmetric = has_symmetries([row for pair in pairs for row in pair])
    return "ADD up to symmetry" if symmetric else "ADD"


def chart_pairs(pairs: Sequence[Pair], names: tuple[str, str]) -> list[Panel]:
    """Return a chart with a dot an image: one run's error against the other's."""
    both = [pair.errors for pair in pairs if all(0 < error < math.inf for error in pair.errors)]
    if not both:
        return []
    least, most = (f(error for errors in both for error in errors) for f in (min, max))
    dots = Line("an image", [a for a, _ in both], [b for _, b in both])
    kind = name_error(pairs)
    title, side, ends = f"{kind} of {names[1]}", f"{kind} of {names[0]} [mm]", (least, most)
    return [Panel(title, side, "mm", [dots], joined=False, log_x=True, log_y=True, diagonal=ends)]


def list_changes_of_images(pairs: Sequence[Pair], names: tuple[str, str]) -> list[Block]:
    """Return the images in which one run is most ahead of the other, by name."""
    out: list[Block] = []
    for sign, name in ((1, names[0]), (-1, names[1])):
        ahead = sorted(
            (pair for pair in pairs if sign * pair.change > EQUAL_MM),
            key=lambda pair: -sign * pair.change,
        )
        rows: list[list[Cell]] = [
            [
                Text(pair.a.image, "code"),
                "–" if math.isnan(pair.a.visibility) else f"{pair.a.visibility:.2f}",
                *(format_length(error / 1000) for error in pair.errors),
            ]
            for pair in ahead[:LISTED]
        ]
        head = ("image", "visible share", *(f"{name_error(pairs)} of {own}" for own in names))
        table = Table(head, rows, numeric=(1, 2, 3))
        out += [Heading(f"Where {name} is most ahead"), table] if rows else []
    return out


def list_settings(a: Run, b: Run, names: tuple[str, str]) -> list[Block]:
    """Return the settings in which two runs differ."""
    known = bool(a.config and b.config)
    first, second = (run.config if known else read_typed(run.overrides) for run in (a, b))
    changed = compare_settings(first, second)
    note = "" if known else "Of an evaluation only what was typed is known, and compared. "
    if not changed:
        return [Paragraph([Text(f"{note}None that is known.", "soft")])]
    said: list[Block] = [Paragraph([Text(note.strip(), "soft")])] if note else []
    return [*said, list_changes(changed, names)]
