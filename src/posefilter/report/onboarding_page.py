"""Lay out what came of onboarding an object: a run's page, with the mesh and where the time
went.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from posefilter.report.blocks import Block, Heading, Paragraph, Section, Table, show_images
from posefilter.report.diagnostics import format_duration
from posefilter.report.gather import Run
from posefilter.report.images import StoredImage
from posefilter.report.page import Page
from posefilter.report.run_page import make_run_page
from posefilter.report.settings import Change


def make_onboarding_page(
    run: Run,
    changed: Sequence[Change] | None,
    command: str,
    values: Mapping[str, Any],
    seconds: Mapping[str, float],
    picture: Path,
) -> Page:
    """Return what the page says.

    Args:
        run: The training and its test on held-out renders.
        changed: Settings that differ from the defaults.
        command: What made the page.
        values: What the stages have found out: the mesh's facts, concerns, symmetries.
        seconds: How long each stage took [s].
        picture: Of the symmetries.
    """
    page = make_run_page(run, changed, command)
    rest = {section.title: section for section in page.sections}
    first = [rest.pop("Results"), rest.pop("Worst and best")]
    image = StoredImage(picture.stem, "the turns that its shape allows", picture.read_bytes())
    mesh: list[Block] = [
        list_facts(values["facts"]),
        *(Paragraph([sentence]) for sentence in values["concerns"]),
        Heading("Symmetries"),
        Paragraph([f"In use: {values['symmetries']}."]),
        *show_images([image]),
    ]
    rows = [[name, format_duration(spent)] for name, spent in seconds.items() if spent]
    times = Table(("stage", "time"), rows, numeric=(1,), form="narrow")
    own = [Section("The mesh", mesh), Section("Where the time went", [times])]
    heading = f"{', '.join(run.data.get('objects') or [])}: from a mesh to weights"
    sections = [*first, *own, *rest.values()]
    return replace(page, title=heading, heading=heading, sections=sections)


def list_facts(facts: Mapping[str, Any]) -> Table:
    """Return what is known of the mesh."""
    size = " x ".join(f"{x:.0f}" for x in facts["size_mm"])
    texture = facts["texture_px_per_mm"]
    rows = [
        ["size", f"{size} mm"],
        ["diameter", f"{facts['diameter_mm']:.1f} mm"],
        ["triangles", f"{facts['faces']}"],
        ["edges that are open", f"{100 * facts['open_edges']:.1f} %"],
        ["texture", f"{texture:.1f} pixels a millimeter" if texture else "none"],
    ]
    return Table(("", ""), rows, form="pairs")
