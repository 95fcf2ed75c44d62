"""Changing a trained method's pieces at test time: `filter.particles=100`, `refine=none`,
`estimate.bandwidth=0.02`.
"""

from typing import Any

from omegaconf import DictConfig, OmegaConf

from posefilter.cli.instantiate import hint
from posefilter.cli.job import Job
from posefilter.errors import UserError

PIECES = (
    "filter",
    "initialize",
    "schedule",
    "reweight",
    "resample",
    "propagate",
    "estimate",
    "refine",
    "model",
)
OWN = (*PIECES, "data")
LOOSE = ("evaluate", "predict", "export")


def loosen(arguments: list[str], name: str) -> list[str]:
    """Let settings of pieces through that only the checkpoint knows: `filter.particles=9` becomes
    `++filter.particles=9`.
    """
    if name not in LOOSE:
        return arguments
    return [
        f"++{a}" if a.split("=", 1)[0].split(".")[0] in OWN and "." in a.split("=", 1)[0] else a
        for a in arguments
    ]


def changes(cfg: DictConfig) -> dict[str, Any]:
    """Return what a test-time configuration says of the pieces."""
    said = {
        name: OmegaConf.to_container(cfg[name], resolve=False)
        for name in PIECES
        if cfg.get(name) is not None
    }
    return {name: value for name, value in said.items() if value}


def chosen(job: Job) -> dict[str, str]:
    """Return the choices that were made at test time, by group."""
    made = {
        group: choice for group, choice in job.choices.items() if not group.startswith("hydra/")
    }
    return {group: choice for group, choice in made.items() if choice not in ("None", "null")}


def changed(trained: dict[str, Any], wanted: dict[str, Any]) -> dict[str, Any]:
    """Return a checkpoint's configuration with pieces chosen anew, or some of their settings
    changed.

    Raises UserError for settings that the trained piece does not have.
    """
    out = dict(trained)
    for piece, settings in wanted.items():
        if piece not in trained:
            raise UserError(f"{piece}: the checkpoint's method has no such piece")
        if "_target_" in settings:
            out[piece] = settings
        else:
            out[piece] = _merged(out[piece], settings, piece)
    return out


def _merged(old: Any, new: dict[str, Any], where: str) -> dict[str, Any]:
    merged = dict(old)
    for key, value in new.items():
        if key not in merged:
            raise UserError(
                f"{where}.{key}: the checkpoint's {where} has no such setting{hint(key, merged)}"
            )
        nested = (
            isinstance(value, dict) and isinstance(merged[key], dict) and "_target_" not in value
        )
        merged[key] = _merged(merged[key], value, f"{where}.{key}") if nested else value
    return merged
