"""Tell whether a dataset fits its meshes: render its own truth, and compare with its masks and its
depth.
"""

import io
import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from posefilter.checking.compare import Fit, View, compare, half_pixel, likely_causes
from posefilter.checking.contact_figure import tile, write_sheet
from posefilter.checking.frames import Suspect, describe_suspects, is_suspect
from posefilter.data.frames import FrameRecord, Implausible, NotShown
from posefilter.data.readers.base import BaseReader
from posefilter.data.readers.checked import index_records, read_checked
from posefilter.data.silhouette import Geometry
from posefilter.errors import BadData, UserError, printable
from posefilter.files import write_whole
from posefilter.meshes.mesh import LOOKALIKE
from posefilter.meshes.store import MeshStore
from posefilter.progress import watched

LEAST_IOU = 0.95
# a depth error is a problem above 5 mm and above 0.8 % of the distance
_DEPTH_MM, _DEPTH_SHARE = 5.0, 0.008
_LISTED = 20  # single frames of an object
_TRIED = 5  # frames on which causes are tried
_TILES = 12  # on the contact sheet


def check_dataset(
    reader: BaseReader,
    meshes: MeshStore,
    limit: int | None = 50,
    out: Path | str | None = None,
    progress: bool = False,
    seed: int = 0,
) -> dict[str, Any]:
    """Compare frames of each of a reader's objects with its mesh, and see whether images that are
    annotated as showing none can be read.

    Args:
        reader: The dataset, opened with on_error="skip": broken files are reported, not raised.
        meshes: The meshes.
        limit: Frames of each object at most, and of none, one of each of so many equal parts; None:
            all.
        out: Gets data_report.json and contact_sheet.png.
        progress: Draw a bar.
        seed: Of the choice of frames.

    Returns:
        `{"objects": [{"object", "frames", "silhouette_iou", "depth_error_mm", "visible_share",
        "empty_masks"}], "problems": [...], "left_out": [...]}`, medians all but the counts; None
        stands for what could not be measured. Problems are sentences that name the likely cause: of
        most frames of an object, or of a single one. Left out are look-alikes of rendered scenes,
        which have no mesh file.

    Raises:
        UserError: The limit is not positive, or the reader does not keep to its protocol.
    """
    if limit is not None and limit < 1:
        raise UserError(f"max_frames={limit}: compare at least one frame of each object")
    reader.add_empty()
    index_records(reader, reader.records())
    geometry = Geometry(meshes)
    problems = [
        f"{reader.examples.get(cause, cause)} ({count} such)"
        for cause, count in reader.skipped.items()
    ]
    problems += _check_empty(reader, limit, progress, seed)
    rows, tiles = [], []
    left_out = [
        name for name in reader.objects if name.startswith(LOOKALIKE) and not meshes.has(name)
    ]
    names = [name for name in reader.objects if name not in left_out]
    share = max(1, _TILES // max(len(names), 1))
    for name in names:
        row, found, drawn = _check_object(reader, geometry, name, limit, share, progress, seed)
        rows.append(row)
        problems += found
        tiles += drawn
    report = {"objects": rows, "problems": problems, "left_out": left_out}
    if out is not None:
        folder = Path(out)
        write_whole(folder / "data_report.json", json.dumps(report, indent=2) + "\n")
        if tiles:
            write_sheet(folder / "contact_sheet.png", tiles)
        else:  # of an earlier dataset
            (folder / "contact_sheet.png").unlink(missing_ok=True)
    return report


def format_report(report: dict[str, Any]) -> str:
    """Return the report as a table, and its problems below."""
    table = Table(
        "object", "frames", "silhouette IoU", r"depth error \[mm]", "visibility", "empty masks"
    )
    for row in report["objects"]:
        numbers = (
            _text(row["silhouette_iou"], 3),
            _text(row["depth_error_mm"], 1),
            _text(row["visible_share"], 2),
            str(row["empty_masks"]),
        )
        table.add_row(Text(row["object"]), str(row["frames"]), *numbers)
    console = Console(width=110, record=True, file=io.StringIO(), color_system=None)
    console.print(table)
    lines = [f"  - {printable(problem)}" for problem in report["problems"]]
    left_out = report["left_out"]
    note = f"left out, look-alikes without a mesh: {', '.join(left_out)}\n" if left_out else ""
    found = "\n".join(["problems:", *lines]) if lines else "no problems found"
    return console.export_text() + note + found


def _check_empty(reader: BaseReader, limit: int | None, progress: bool, seed: int) -> list[str]:
    """Return which of the images that are annotated as showing no object cannot be read."""
    records = reader.records()
    chosen = _choose(records, "", limit, seed)
    broken = []
    for i in watched(chosen, len(chosen), "no object", progress):
        try:
            read_checked(reader, i, records[i])
        except BadData as error:
            broken.append((error.cause, str(error)))
    return _count_broken(broken, len(chosen))


def _choose(records: Sequence[FrameRecord], name: str, limit: int | None, seed: int) -> list[int]:
    """Return the places of a class's records that are looked at."""
    mine = [i for i, record in enumerate(records) if record.object == name]
    count = min(limit or len(mine), len(mine))
    # at random within equal parts: a fixed step may be a multiple of the dataset's own period
    shifts = np.random.default_rng(seed).random(count)
    places = (np.arange(count) + shifts) * len(mine) / max(count, 1)
    return [mine[k] for k in places.astype(int)]


def _count_broken(broken: Sequence[tuple[str, str]], looked_at: int) -> list[str]:
    """Return a sentence for each cause of broken frames, given as causes and messages."""
    first = dict(reversed(broken))
    return [
        f"{first[cause]} ({count} such of {looked_at} frames looked at)"
        for cause, count in Counter(cause for cause, _ in broken).items()
    ]


def _check_object(
    reader: BaseReader,
    geometry: Geometry,
    name: str,
    limit: int | None,
    drawn: int,
    progress: bool,
    seed: int,
) -> tuple[dict[str, Any], list[str], list[np.ndarray]]:
    """Return an object's row, its problems and its tiles."""
    records = reader.records()
    mesh = geometry.mesh(name)
    if mesh is None:
        return _row(name, [], 0), [f"{name}: no mesh of this name in {geometry.meshes.root}"], []
    native = reader.native_from_mesh(name)
    chosen = _choose(records, name, limit, seed)
    broken: list[tuple[str, str]] = []  # cause and message
    not_shown = 0
    views: list[View] = []
    fits: list[Fit] = []
    tiles: list[np.ndarray] = []
    suspects: list[Suspect] = []
    for i in watched(chosen, len(chosen), name, progress):
        flaw = ""
        try:
            try:
                sample = read_checked(reader, i, records[i])
            except Implausible as error:
                sample, flaw = error.sample, str(error)
            view = View(sample, reader.others(i), mesh, native)
        except NotShown:
            not_shown += 1
            continue
        except BadData as error:
            broken.append((error.cause, str(error)))
            continue
        fit = compare(view, geometry)
        fits.append(fit)
        if (flaw or is_suspect(view, fit)) and len(suspects) < _LISTED:
            suspects.append(Suspect(f"{records[i].name} {name}", view, fit, flaw))
        if len(views) < _TRIED:
            views.append(view)
        if len(tiles) < drawn:
            tiles.append(tile(view, fit, f"{records[i].name} {name}"))
    problems = _count_broken(broken, len(chosen))
    row = _row(name, fits, not_shown)
    if not fits:
        return row, [*problems, f"{name}: no frame shows it"], tiles
    general = _judge(row, views, fits, geometry)
    if all("no cause" in problem for problem in general):
        # what is wrong with most frames is told once, unless they differ
        general += describe_suspects(suspects, geometry, only_explained=bool(general))
    return row, problems + general, tiles


def _judge(
    row: dict[str, Any], views: Sequence[View], fits: Sequence[Fit], geometry: Geometry
) -> list[str]:
    """Return what is wrong with an object's frames, and the likely cause."""
    name, iou, error = row["object"], row["silhouette_iou"], row["depth_error_mm"]
    tried = float(np.median([fit.iou for fit in fits[: len(views)]]))
    depths = [fit.rendered[fit.rendered > 0] for fit in fits]
    distance = float(np.median([np.median(known) if known.size else 1 for known in depths]))
    bad_depth = error is not None and error > max(_DEPTH_MM, _DEPTH_SHARE * distance * 1000)
    if (iou < LEAST_IOU or bad_depth) and (causes := likely_causes(views, geometry, tried)):
        return [f"{name}: {cause}" for cause in causes]
    if slip := half_pixel(views, geometry, tried):
        return [f"{name}: {slip}"]
    problems = []
    if iou < LEAST_IOU:
        problems.append(
            f"{name}: silhouette IoU {iou:.3f}, below {LEAST_IOU}; no cause that was "
            f"tried explains it"
        )
    if bad_depth:
        problems.append(
            f"{name}: depth is {error:.0f} mm off (median); no cause that was tried explains it"
        )
    return problems


def _row(name: str, fits: Sequence[Fit], empty_masks: int) -> dict[str, Any]:
    return {
        "object": name,
        "frames": len(fits),
        "silhouette_iou": _median([fit.iou for fit in fits]),
        "depth_error_mm": _median([fit.depth_error_mm for fit in fits]),
        "visible_share": _median([fit.visible_share for fit in fits]),
        "empty_masks": empty_masks,
    }


def _median(values: Sequence[float]) -> float | None:
    known = [value for value in values if np.isfinite(value)]
    return round(float(np.median(known)), 4) if known else None


def _text(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
