"""Changing a trained method at test time: `filter.particles=100`, `filter/refine=none`."""

from typing import Any

from omegaconf import DictConfig

from posefilter.cli.instantiate import hint
from posefilter.cli.job import Job
from posefilter.cli.plain import unresolved
from posefilter.errors import UserError

SECTIONS = ("filter", "model")
# settings that recipes of earlier versions leave out
_LATER = ("filter.max_searches", "filter.magnified_width")
LOOSE = ("evaluate", "predict", "track", "convert_bag", "export", "calibrate")


def loosen(arguments: list[str], name: str) -> list[str]:
    """Let settings through that only the checkpoint knows: `filter.particles=9` gets a `++`."""
    if name not in LOOSE:
        return arguments
    keys = tuple(f"{section}." for section in (*SECTIONS, "data"))
    return [f"++{a}" if a.startswith(keys) else a for a in arguments]


def changes(cfg: DictConfig) -> dict[str, Any]:
    """Return what a test-time configuration says of the method."""
    return {name: unresolved(cfg[name]) for name in SECTIONS if cfg.get(name)}


def chosen(job: Job) -> dict[str, str]:
    """Return the choices that were made at test time, by group."""
    return {
        group: choice
        for group, choice in job.choices.items()
        if not group.startswith("hydra/") and choice not in ("None", "null")
    }


def changed(old: dict[str, Any], new: dict[str, Any], where: str = "") -> dict[str, Any]:
    """Return a checkpoint's settings with some changed: a component that is chosen anew is
    replaced, any other section merged. So is a method whose class is another, `model._target_=`,
    which may have settings of its own.

    Args:
        old: What the method was trained with.
        new: The settings to change.
        where: The section that they are of.

    Raises:
        UserError: A setting that the trained method does not have.
    """
    merged = dict(old)
    for key, value in new.items():
        place = f"{where}.{key}" if where else key
        if key not in merged:
            if place in _LATER or "_target_" in new:  # another class may have other settings
                merged[key] = value
                continue
            section = where or "method"
            raise UserError(
                f"{place}: the checkpoint's {section} has no such setting{hint(key, merged)}"
            )
        here = merged[key]
        if isinstance(here, list) and isinstance(value, dict):  # `components.1.pixels=64`
            numbered = {str(number): one for number, one in enumerate(here)}
            merged[key] = list(changed(numbered, value, place).values())
        elif (
            isinstance(here, dict)
            and isinstance(value, dict)
            # the method itself has no group: `model._target_=` keeps what it is made of
            and ("_target_" not in value or place in SECTIONS)
        ):
            merged[key] = changed(here, value, place)
        else:
            merged[key] = value
    return merged
