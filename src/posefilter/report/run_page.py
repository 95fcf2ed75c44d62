"""Lay a run out on one page."""

from collections.abc import Sequence
from datetime import datetime
from html import escape
from typing import Any

from posefilter.report import html, panels
from posefilter.report.diagnostics import collect_numbers, collect_timings, diagnose, read_last_validation
from posefilter.report.gather import Run
from posefilter.report.images import group_by_section
from posefilter.report.settings import Change

HEADLINE = (  # key, unit, label, format
    ("add/auc", "", "ADD AUC", "{:.1f}"),
    ("add_s/auc", "", "ADD-S AUC", "{:.1f}"),
    ("add/recall_01d", "%", "ADD below 0.1 diameter", "{:.1f}"),
    ("add/median_mm", "mm", "median ADD", "{:.1f}"),
    ("iou", "", "box IoU", "{:.3f}"),
    ("particles_on_object", "%", "particles on the object", "{:.1%}"),
    ("seconds_per_image", "s", "time an image", "{:.3g}"),
)
ROWS = (
    ("instances", "images", "{:.0f}"),
    ("missed", "missed", "{:.0f}"),
    ("add/auc", "ADD AUC", "{:.1f}"),
    ("add/recall_01d", "ADD below 0.1 diameter", "{:.1f} %"),
    ("add/recall_2cm", "ADD below 2 cm", "{:.1f} %"),
    ("add/median_mm", "ADD, median", "{:.1f} mm"),
    ("add_s/auc", "ADD-S AUC", "{:.1f}"),
    ("add_s/recall_01d", "ADD-S below 0.1 diameter", "{:.1f} %"),
    ("add_s/recall_2cm", "ADD-S below 2 cm", "{:.1f} %"),
    ("add_s/median_mm", "ADD-S, median", "{:.1f} mm"),
    ("iou", "box IoU", "{:.3f}"),
    ("particles_on_object", "particles on the object", "{:.1%}"),
    ("seconds_per_image", "time an image", "{:.3f} s"),
)
BELIEF = (
    ("effective_particles", "effective particles", "{:.1f}", "1 / Σw²: how many particles carry the weight"),
    ("entropy", "entropy", "{:.2f} nat", "of the weights: 0 where one particle has all"),
    ("spread_m", "spread of the centers", "{:.3f} m", "weighted root mean square about the mean"),
    ("spread_rad", "spread of the rotations", "{:.2f} rad", "the same, of the angle"),
    ("mass_01d", "weight within 0.1 diameters of the truth", "{:.1%}", "1 where the belief is sure and right"),
    ("mass_2cm", "weight within 2 cm of the truth", "{:.1%}", ""),
    ("rank", "depth of the truth in the belief", "{:.2f}", "0.5 where calibrated; near 1: the truth lies outside"),
    ("coverage_50", "truths within the 50 % region", "{:.0f} %", "50 where calibrated; fewer: too sure"),
    ("coverage_90", "truths within the 90 % region", "{:.0f} %", "90 where calibrated; fewer: too sure"),
    ("truth_outscored", "images in which a particle outscores the truth", "{:.1%}", ""),
    ("truth_outscored_by_wrong", "images in which a wrong pose outscores it", "{:.1%}", "what no search can mend"),
)


def run_page(run: Run, changed: Sequence[Change] | None, command: str) -> tuple[str, dict[str, bytes]]:
    """Return the page, and its charts as PNGs by file name.

    changed: settings that differ from the defaults; None where there is nothing to compare with. command: what made the
    page.
    """
    files: dict[str, bytes] = {}

    def charts(found: Sequence[panels.Panel]) -> str:
        content, pngs = html.charts(found)
        files.update(pngs)
        return content

    shown = group_by_section([p for p in run.pictures if p.name not in ("filter_health", "filter/health")])
    sections = [
        ("Signs of failure", signs(run) + charts(panels.choose_panels(run.curves, panels.SIGNS))),
        ("Worst and best", worst_and_best(shown)),
        ("Results", results(run)),
        ("Curves", charts([*panels.choose_panels(run.curves, panels.VALIDATION), *panels.make_training_panels(run.curves)])),
        (
            "Belief",
            belief(run) + charts(panels.choose_panels(run.curves, panels.BELIEF)) + html.gallery(shown["belief"], wide=True),
        ),
        ("The filter at work", charts(panels.make_health_panels(run.curves)) + html.gallery(shown["particles"], wide=True)),
        ("More pictures", html.gallery(shown["more"], wide=True)),
        ("Settings", settings(run, changed)),
        ("Time and machine", machine(run)),
    ]
    title = f"{run.folder.resolve().name}: {run.named('model')}"
    return html.page(title, head(run), sections, foot(run, command)), files


def head(run: Run) -> str:
    """Return what is read first."""
    step, _ = read_last_validation(run.curves)
    train = run.curves.get("train/total")
    most = (run.config.get("trainer") or {}).get("max_steps")
    if run.metrics:
        badge = '<span class="badge done">tested</span>'
        told = f"on {int(run.metrics.get('instances') or 0)} images"
    else:
        badge = '<span class="badge">not tested yet</span>'
        told = f"at step {train.steps[-1] + 1}" + (f" of {most}" if most else "") if train else "nothing logged yet"
        told += f"; figures of the validation at step {step + 1}" if step is not None else ""
    objects = ", ".join(run.data.get("objects") or []) or str((run.config.get("data") or {}).get("object") or "")
    line = " · ".join(part for part in (run.named("variant"), f"loss {run.named('loss')}", objects) if part)
    return (
        f"<h1>{escape(run.named('model'))}</h1>"
        f"<p>{badge} {escape(told)}<br>{escape(line)}<br>{html.code(str(run.folder))}</p>"
        + tiles(run)
        + html.notes(run.missing)
    )


def tiles(run: Run) -> str:
    """Return a run's main figures."""
    known = collect_numbers(run)
    return html.tiles(
        [(form.format(known[key]).rstrip("%"), unit, label) for key, unit, label, form in HEADLINE if key in known]
    )


def signs(run: Run) -> str:
    """Return the table of the signs of failure."""
    found = diagnose(run)
    bad = sum(finding.bad for finding in found)
    if not found:
        return ""
    say = f"{bad} of {len(found)} signs are there." if bad else f"None of {len(found)} signs is there."
    rows = [
        (
            '<span class="bad">✗ yes</span>' if bad else '<span class="good">✓ no</span>',
            escape(sign.label),
            f"{value:.3g}",
            f'<span class="soft">bad {"above" if sign.above else "below"} {sign.limit:g}</span>',
            escape(sign.meaning) if bad else f'<span class="soft">{escape(sign.meaning)}</span>',
        )
        for sign, value, bad in found
    ]
    return f"<p>{say}</p>" + html.table(
        ("there?", "measured", "value", "", "it would mean"), rows, numeric=(2, 3), kind="signs"
    )


def worst_and_best(shown: dict[str, list[Any]]) -> str:
    """Return the gallery."""
    parts = (("Worst", "worst"), ("Best", "best"), ("Estimates", "overlays"))
    return "".join(f"<h3>{title}</h3>{html.gallery(shown[key])}" for title, key in parts if shown[key])


def results(run: Run) -> str:
    """Return the final table, and the errors by visibility."""
    if not run.metrics:
        return ""
    columns = [("test", run.metrics)]
    if run.metrics_train:
        columns = [("evaluation", run.metrics), ("test after training", run.metrics_train)]
    known = [collect_numbers(Run(**{**run.__dict__, "metrics": metrics})) for _, metrics in columns]
    rows = [
        (label, *(form.format(own[key]) if key in own else "–" for own in known))
        for key, label, form in ROWS
        if any(key in own for own in known)
    ]
    out = html.table(("", *(name for name, _ in columns)), rows, numeric=range(1, len(columns) + 1), kind="narrow")
    by_visibility = run.metrics.get("by_visibility") or {}
    rows = [
        (
            escape(name).replace("-", " to "),
            str(own["instances"]),
            *(cell(own, *keys) for keys in (("add", "auc"), ("add", "recall_01d"), ("add", "median_mm"), ("add_s", "auc"))),
        )
        for name, own in by_visibility.items()
    ]
    titles = ("visible share", "images", "ADD AUC", "ADD < 0.1 d [%]", "median ADD [mm]", "ADD-S AUC")
    return out + ("<h3>By visibility</h3>" + html.table(titles, rows, numeric=range(1, 6)) if rows else "")


def cell(content: dict[str, Any], *keys: str) -> str:
    """Return a nested number, a dash where there is none."""
    value: Any = content
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return "–" if value is None else f"{value:.1f}"


def belief(run: Run) -> str:
    """Return what the belief's numbers are, and mean."""
    known = collect_numbers(run)
    rows = [
        (escape(label), form.format(known[f"belief/{key}"]), f'<span class="soft">{escape(meaning)}</span>')
        for key, label, form, meaning in BELIEF
        if f"belief/{key}" in known
    ]
    return html.table(("mean over the images", "", ""), rows, numeric=(1,), kind="meanings")


def settings(run: Run, changed: Sequence[Change] | None) -> str:
    """Return how the run differs from the default, and its choices."""
    typed = " ".join(run.overrides)
    out = f"<p>Typed: {html.code(typed) if typed else 'nothing: all is default'}</p>" if run.config or run.overrides else ""
    if changed is None:
        out += '<p class="soft">These settings cannot be compared with today\'s defaults.</p>' if run.config else ""
    else:
        rows = [
            (html.code(key), *(html.code(short(value)) if value is not None else "–" for value in (own, default)))
            for key, default, own in changed
        ]
        name = f"model={run.named('model')} variant={run.named('variant')}"
        say = f"Settings that differ from the defaults of {html.code(name)} in this version of the code:"
        out += f"<p>{say if rows else say.replace('Settings that', 'No settings')}</p>" + html.table(
            ("setting", "this run", "default"), rows, kind="settings"
        )
    own = [
        (html.code(k), html.code(v)) for k, v in sorted(run.choices.items()) if not k.startswith("hydra/") and v != "null"
    ]
    return out + html.fold(f"All {len(own)} choices", html.table(("group", "choice"), own)) if own else out


def short(text: str, most: int = 160) -> str:
    """Return a setting that fits in a table."""
    return text if len(text) <= most else text[: most - 1] + "…"


def machine(run: Run) -> str:
    """Return how long it took, on what, with which data and code."""
    metrics = run.metrics
    rows = [(escape(label), escape(value)) for label, value in collect_timings(run)]
    rows += [
        (key, html.code(str(metrics[key])))
        for key in ("device", "git", "checkpoint", "seed")
        if metrics.get(key) is not None
    ]
    if versions := metrics.get("versions"):
        rows.append(("versions", escape(", ".join(f"{name} {value}" for name, value in versions.items()))))
    data = metrics.get("data") or run.data
    if data.get("root"):
        rows.append(("data", f"{escape(str(data.get('source')))}, {html.code(str(data['root']))}"))
    for name, split in (data.get("splits") or {}).items():
        rows.append((f"data, {escape(name)}", f"{split.get('frames')} frames of {split.get('scenes')} scenes"))
    return html.table(("", ""), rows, kind="pairs")


def foot(run: Run, command: str) -> str:
    """Return where the page is from."""
    times = [curve.times[-1] for curve in run.curves.values()]
    last = f" Last logged {datetime.fromtimestamp(max(times)):%Y-%m-%d %H:%M}." if times else ""
    return f"Made with {html.code(command)}.{last}"
