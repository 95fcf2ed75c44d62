"""Tell in which settings a run differs from the defaults of its method."""

import json
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

# by whose change nothing else comes out
HANDS = ("out", "console", "tags", "threads", "data.workers", "data.generate.workers")
SILENT = (*HANDS, "resume", "plugins")  # that set no job of a sweep apart
# where and how a run was made, not what it was
PASSING = ("out", "folder", "console", "threads", "resume", "debug", "plugins")


class Change(NamedTuple):
    """One setting; an absent one is None."""

    key: str
    default: str | None
    own: str | None


def compare_settings(config: Mapping[str, Any], default: Mapping[str, Any]) -> list[Change]:
    """Return the settings that differ, in the run's order, those that it lacks last."""
    own, usual = flatten_settings(config), flatten_settings(default)
    return [
        Change(key, usual.get(key), own.get(key))
        for key in own | usual
        if key.split(".")[0] not in PASSING and own.get(key) != usual.get(key)
    ]


def flatten_settings(config: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Return a configuration's settings by dotted key; a list is one setting, unless it holds
    sections.
    """
    out: dict[str, str] = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        if isinstance(value, list) and any(isinstance(item, Mapping) for item in value):
            value = {str(i): item for i, item in enumerate(value)}
        if isinstance(value, Mapping):
            out |= flatten_settings(value, f"{name}.")
        else:
            out[name] = value if isinstance(value, str) else json.dumps(value, default=str)
    return out


def read_typed(overrides: Iterable[str]) -> dict[str, str]:
    """Return typed settings by their key."""
    return dict(one.lstrip("+~").split("=", 1) for one in overrides if "=" in one)
