"""What a run is told apart by from others: its choices, and every plain setting."""

from collections.abc import Iterator, Mapping
from typing import Any

from posefilter.cli.components import chosen
from posefilter.cli.job import Job
from posefilter.cli.plain import to_plain
from posefilter.report.settings import HANDS, PASSING

_PLACES = ("data.root", "data.cache_dir")
_PASSING = (*PASSING, "callbacks", "logger")  # where and how, not what


def comparable(job: Job) -> dict[str, bool | int | float | str]:
    """Return a job's choices, and its settings by dotted key but for those that repeat others."""
    choices: dict[str, bool | int | float | str] = {
        group: choice
        for group, choice in chosen(job).items()
        if group.split("/")[0] not in _PASSING
    }
    settings = to_plain(job.cfg)
    return choices | dict(leaves({k: value for k, value in settings.items() if k not in _PASSING}))


def differing(then: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return the choices and settings in which two recipes differ, as by a default of today."""
    groups = {
        group
        for group in {*then["choices"]} & {*now["choices"]}
        if then["choices"][group] != now["choices"][group]
    }
    before, after = (dict(flat(recipe["settings"])) for recipe in (then, now))
    settings = {key for key in {*before, *after} if before.get(key) != after.get(key)}
    return sorted(
        k
        for k in groups | settings
        if k not in (*HANDS, *_PLACES) and k.split(".")[0] not in _PASSING
    )


def flat(node: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every value of nested settings, those in lists too, by its dotted key."""
    if not isinstance(node, Mapping | list):
        yield name, node
        return
    for key, value in node.items() if isinstance(node, Mapping) else enumerate(node):
        yield from flat(value, f"{name}.{key}" if name else str(key))


def leaves(
    node: Mapping[Any, Any], prefix: str = ""
) -> Iterator[tuple[str, bool | int | float | str]]:
    """Yield the settings of a section: neither nulls, nor interpolations (they repeat another), nor
    classes' names.
    """
    for key, value in node.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from leaves(value, f"{name}.")
        elif isinstance(value, list):
            if not any(isinstance(item, Mapping) for item in value):
                yield name, str(value)
        elif (
            value is not None
            and not str(key).startswith("_")
            and not (isinstance(value, str) and "${" in value)
        ):
            yield name, value
