"""Lay a run out on one page."""

from collections.abc import Mapping, Sequence
from datetime import datetime

from posefilter.metrics.registry import find_metric
from posefilter.report import panels
from posefilter.report.beliefs import show_calibration
from posefilter.report.blocks import (
    Block,
    Cell,
    Fold,
    Heading,
    Paragraph,
    Section,
    Table,
    Text,
    Tile,
    draw_charts,
    show_images,
)  # fmt: skip
from posefilter.report.charts import shorten
from posefilter.report.diagnostics import (
    collect_numbers,
    collect_timings,
    diagnose,
    read_last_validation,
)
from posefilter.report.events import name_figure
from posefilter.report.gather import Run
from posefilter.report.image_errors import show_errors
from posefilter.report.images import StoredImage, group_by_section
from posefilter.report.page import Page
from posefilter.report.result_tables import list_belief, list_results
from posefilter.report.settings import Change

HEADLINE = (
    "add/auc", "add_s/auc", "add/recall_01d", "add/median_mm", "iou", "particles_on_object",
    "seconds_per_image",
)  # fmt: skip


def make_run_page(run: Run, changed: Sequence[Change] | None, command: str) -> Page:
    """Return what a run's page says.

    Args:
        run: What its folder holds.
        changed: Settings that differ from the defaults; None where there is nothing to compare
            with.
        command: What made the page.
    """
    images = group_by_section([p for p in run.pictures if name_figure(p.name) != "health"])
    signs = panels.choose_panels(run.curves, panels.SIGNS)
    validation = panels.choose_panels(run.curves, panels.VALIDATION)
    training = panels.make_training_panels(run.curves)
    beliefs = draw_charts(panels.choose_panels(run.curves, panels.BELIEF))
    belief = [*list_belief(run), *show_calibration(run.metrics), *beliefs]
    health = draw_charts(panels.make_health_panels(run.curves))
    sections = [
        Section("Diagnostics", [*list_diagnostics(run), *draw_charts(signs)]),
        Section("Worst and best", show_worst_and_best(images)),
        Section("Results", [*list_results(run), *show_errors(run.errors)]),
        Section("Curves", draw_charts([*validation, *training])),
        Section("Belief", [*belief, *show_images(images["belief"], wide=True)]),
        Section("The filter at work", [*health, *show_images(images["particles"], wide=True)]),
        Section("More images", show_images(images["more"], wide=True)),
        Section("Settings", list_settings(run, changed)),
        Section("Time and machine", [list_machine(run)]),
    ]
    name, foot = run.named("model"), make_foot(run, command)
    title = f"{run.folder.resolve().name}: {name}"
    return Page(title, name, head_lines(run), make_tiles(run), run.missing, sections, foot)


def head_lines(run: Run) -> list[Paragraph]:
    """Return what stands below the heading: how far the run is, what it is, where it is."""
    step, _ = read_last_validation(run.curves)
    train = run.curves.get("train/loss")
    most = (run.config.get("trainer") or {}).get("max_steps")
    if run.metrics:
        badge, state = Text("tested", "done"), f"on {int(run.metrics.get('instances') or 0)} images"
    else:
        badge, state = Text("not tested yet", "badge"), "nothing logged yet"
        if train:
            state = f"at step {train.steps[-1] + 1}" + (
                f" of {most}" if isinstance(most, int) and most > 0 else ""
            )
        state += f"; numbers of the validation at step {step}" if step is not None else ""
    chosen = (run.config.get("data") or {}).get("object") or ""
    objects = ", ".join(run.data.get("objects") or []) or str(chosen)
    parts = (run.named("variant"), f"loss {run.named('loss')}", objects)
    line = " · ".join(part for part in parts if part)
    where = Text(str(run.folder), "code")
    return [Paragraph([badge, state]), Paragraph([line]), Paragraph([where])]


def make_tiles(run: Run) -> list[Tile]:
    """Return a run's main numbers."""
    known = collect_numbers(run)
    infos = [find_metric(key) for key in HEADLINE if key in known]
    return [Tile(*info.split(known[info.key]), info.label) for info in infos]


def list_diagnostics(run: Run) -> list[Block]:
    """Return the table of the diagnostics."""
    found = diagnose(run)
    bad = sum(finding.bad for finding in found)
    if not found:
        return []
    count = f"of {len(found)} signs of failure"
    say = f"{bad} {count} are there." if bad else f"None {count} is there."
    rows: list[list[Cell]] = []
    for one, value, is_bad in found:
        side = "above" if one.info.direction < 0 else "below"
        limit = Text(f"bad {side} {one.info.describe(one.limit)}", "soft")
        there = Text("✗ yes", "bad") if is_bad else Text("✓ no", "good")
        meaning = one.meaning if is_bad else Text(one.meaning, "soft")
        rows.append([there, one.info.label, one.info.describe(value), limit, meaning])
    head = ("there?", "measured", "value", "", "it would mean")
    return [Paragraph([say]), Table(head, rows, numeric=(2, 3), form="signs")]


def show_worst_and_best(images: Mapping[str, list[StoredImage]]) -> list[Block]:
    """Return the worst and the best images, those of the test before those of the last
    validation.
    """
    out: list[Block] = []
    for title, key in (("Worst", "worst"), ("Best", "best"), ("Estimates", "overlays")):
        ordered = sorted(images[key], key=lambda image: not image.name.startswith("test"))
        shown = show_images(ordered, wide=True)
        out += [Heading(title), *shown] if shown else []
    return out


def list_settings(run: Run, changed: Sequence[Change] | None) -> list[Block]:
    """Return how the run differs from the default, and its choices."""
    typed = " ".join(run.overrides)
    out: list[Block] = []
    if run.config or run.overrides:
        said = Text(typed, "code") if typed else "nothing: all is default"
        out.append(Paragraph(["Typed:", said]))
    if changed is not None:
        name = Text(f"model={run.named('model')} variant={run.named('variant')}", "code")
        which = f"{'Settings that' if changed else 'No settings'} differ from the defaults of"
        out.append(Paragraph([which, name, "in this version of the code."]))
        out.append(list_changes(changed, ("this run", "default")))
    elif run.config:
        said = Text("These settings cannot be compared with today's defaults.", "soft")
        out.append(Paragraph([said]))
    choices = [
        (k, v) for k, v in sorted(run.choices.items()) if not k.startswith("hydra/") and v != "null"
    ]
    rows = [[Text(group, "code"), Text(choice, "code")] for group, choice in choices]
    table = Table(("group", "choice"), rows)
    return [*out, Fold(f"All {len(rows)} choices", [table])] if rows else out


def list_changes(changed: Sequence[Change], names: tuple[str, str]) -> Table:
    """Return the settings in which two configurations differ; names: of the own and of the other
    one.
    """

    def cell(value: str | None) -> Cell:
        return "–" if value is None else Text(shorten(value, 160), "code")

    rows = [[Text(key, "code"), cell(own), cell(other)] for key, other, own in changed]
    return Table(("setting", *names), rows, form="settings")


def list_machine(run: Run) -> Table:
    """Return how long it took, on what, with which data and code."""
    metrics = run.metrics
    rows: list[list[Cell]] = [[label, value] for label, value in collect_timings(run)]
    for key in ("device", "git", "checkpoint", "seed"):
        rows += [[key, Text(str(metrics[key]), "code")]] if metrics.get(key) is not None else []
    if versions := metrics.get("versions"):
        rows.append(["versions", ", ".join(f"{name} {value}" for name, value in versions.items())])
    data = metrics.get("data") or run.data
    if data.get("root"):
        rows.append([f"data, from {data.get('source')}", Text(str(data["root"]), "code")])
    for name, split in (data.get("splits") or {}).items():
        size = f"{split.get('frames')} frames of {split.get('scenes')} scenes"
        rows.append([f"data, {name}", size])
    return Table(("", ""), rows, form="pairs")


def make_foot(run: Run, command: str) -> Paragraph:
    """Return where the page is from."""
    times = [curve.times[-1] for curve in run.curves.values()]
    last = [f"Last logged {datetime.fromtimestamp(max(times)):%Y-%m-%d %H:%M}."] if times else []
    return Paragraph(["Made with", Text(command, "code"), *last])
