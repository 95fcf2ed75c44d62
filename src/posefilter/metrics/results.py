"""Metrics in the form of metrics.json: flat names, and one score."""

from collections.abc import Mapping
from typing import Any

from posefilter.metrics.scores import overall


def compute_checkpoint_score(results: dict[str, Any]) -> float:
    """Return the score by which checkpoints are compared, from metrics.json (see `overall`)."""
    add = results.get("add_up_to_symmetry") or results["add"]
    auc = float(add["auc"]) if add else None
    return overall(auc, float(results["particles_on_object"] or 0.0), float(results["iou"]))


def flatten(results: Mapping[str, Any], prefix: str = "") -> dict[str, float]:
    """Return nested numbers by joined names; values that are no numbers are left out."""
    out: dict[str, float] = {}
    for name, value in results.items():
        if isinstance(value, Mapping):
            out |= flatten(value, f"{prefix}{name}/")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            out[prefix + name] = float(value)
    return out
