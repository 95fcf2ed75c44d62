"""Results: metrics.json, and the table on the console."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from posefilter.cli.console import Files, ended, finite, show_table
from posefilter.cli.job import Job
from posefilter.cli.machine import device_name, git_state, versions
from posefilter.errors import UserError
from posefilter.files import write_whole
from posefilter.metrics.registry import find_metric, read_number

_ROWS = (
    "bop/ar", "bop/ar_vsd", "bop/ar_mssd", "bop/ar_mspd",
    "add/auc", "add/recall_01d", "add/recall_2cm", "add/median_mm", "add_s/auc", "add_s/median_mm",
    "add_up_to_symmetry/auc", "add_up_to_symmetry/median_mm",
    "iou", "parts/box_iou", "parts/mask_iou", "particles_on_object", "seconds_per_image",
)  # fmt: skip
_TOLD = (  # to machines
    "instances", "missed", "add", "add_s", "add_up_to_symmetry", "mssd", "mspd", "bop", "iou",
    "parts", "particles_on_object", "seconds_per_image", "belief",
)  # fmt: skip


def record(
    results: dict[str, Any],
    job: Job,
    data: dict[str, Any],
    checkpoint: Path | None,
    device: torch.device | None = None,
) -> dict[str, Any]:
    """Return metrics.json: what was found, where, and all that it takes to find it again.

    Raises:
        UserError: No image was tested.
    """
    if not results["instances"]:
        raise UserError(
            "no image was tested, so that there are no results to write (did the processes that "
            "test end with what they found?)"
        )
    return {
        **results,
        **{group: job.choices.get(group) for group in ("model", "loss", "variant")},
        "seed": job.cfg.get("seed"),
        "tags": [*(job.cfg.get("tags") or [])],
        "data": data,
        "checkpoint": str(checkpoint) if checkpoint else None,
        "git": git_state(),
        "device": device_name(device),
        "versions": versions(),
        "overrides": job.overrides,
    }


def write_json(path: Path, content: Any) -> None:
    """Write JSON that any parser reads: numbers that are none become null; whole or not at all."""
    text = json.dumps(finite(content), indent=2, allow_nan=False) + "\n"
    write_whole(path, text, sync=True)


def show(
    metrics: dict[str, Any],
    title: str,
    console: str,
    event: str,
    files: Files,
    following: Sequence[str] = (),
) -> None:
    """Print the table, where everything was written, and what may be typed next; for machines, all
    of it as one line.
    """
    rows = [("instances", str(metrics["instances"])), ("missed", str(metrics["missed"]))]
    numbers = {key: read_number(metrics, key) for key in _ROWS}
    rows += [
        (find_metric(key).label, find_metric(key).describe(value))
        for key, value in numbers.items()
        if value is not None
    ]
    show_table(console, title, rows)
    told = {key: metrics[key] for key in _TOLD if key in metrics}
    ended(console, event, files, following, title=title, **told)
