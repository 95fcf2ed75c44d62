"""Names of settings that have changed: what was typed before, and what is typed now.

The tables are in `old_names.py`.
"""

import re
from collections.abc import Mapping
from typing import Any

from posefilter.cli.old_names import (
    ARGUMENTS,
    BASES,
    CHOICES,
    CLASSES,
    COMMANDS,
    GROUPS,
    KEYS,
    OPTIONS,
    VALUES,
)

_NAMES = GROUPS | KEYS
_NODES = {"loss/schedule": "model.loss_schedule"}
_LOSSES = {"relevance": "objectness"}  # in the stages of a training
_DATA = "data.module.PoseDataModule"  # whose options are those of its reader
_MISSING = {
    f"data.options.{old}": f"data.options.{new}"
    for names in OPTIONS.values()
    for old, new in names.items()
}
_BUDGET = "the preset, with its size apart: preset/size="


def rename(override: str, command: str | None = None) -> str | None:
    """Return what is typed today for an override with names of before; None where nothing changed.

    Args:
        override: As typed, such as `initialise=uniform` or `resample.alpha=0.2`.
        command: Whose setting it is, for names that single commands have; None: any.
    """
    sign, key, equals, value = _split(override)
    if key == "budget":
        return _BUDGET + value.partition("/")[0]
    commands = (own for name, own in COMMANDS.items() if command in (None, name))
    new = next((own[key] for own in commands if key in own), key)
    # a name of before that, too
    while (newer := _rename_key(new)) != new:
        new = newer
    # its values are turned round, so that they are renamed together with their key alone
    choices = {} if key == new == "model.detach_position" else _choices_of(new)
    values = ",".join(choices.get(one, one) for one in value.split(","))
    if (new, values) == (key, value):
        return None
    return f"{sign}{new}{equals}{values}"


def update(override: str, command: str | None = None) -> str:
    """Return a recorded override as it is typed today."""
    # for a budget there is no one override of today
    return override if override.startswith("budget=") else rename(override, command) or override


def rename_missing(key: str, command: str | None = None) -> str | None:
    """Return what a setting that there is not is called today: also of those whose name a reader of
    one's own may have.
    """
    return rename(key, command) or _MISSING.get(key)


def _split(override: str) -> tuple[str, str, str, str]:
    found = re.fullmatch(r"([+~]*)([^=]*)(=?)(.*)", override, re.DOTALL)
    assert found is not None
    return found[1], found[2], found[3], found[4]


def _rename_key(key: str) -> str:
    if key in _NAMES:
        return _NAMES[key]
    group, at, package = key.partition("@")
    if at:  # a choice whose settings go elsewhere
        return f"{group}@{_rename_key(package)}"
    head, dot, rest = key.partition(".")
    if not dot:
        return key
    if head in GROUPS:
        group = GROUPS[head]
        return f"{_NODES.get(group, group.replace('/', '.'))}.{rest}"
    parts = key.split(".")
    places = (".".join(parts[:n]) for n in range(len(parts), 0, -1))
    place = next((one for one in places if one in KEYS), None)
    return key if place is None else KEYS[place] + key.removeprefix(place)


def _choices_of(group: str) -> Mapping[str, str]:
    """Return the renamed choices of a group, wherever its settings go: `filter/resample@...`."""
    return CHOICES.get(group.partition("@")[0], {})


def find_renamed(recipe: Mapping[str, Any]) -> tuple[str, str] | None:
    """Return the first group or setting of before in a checkpoint's recipe whose values have
    changed too, and today's name; None where there is none.

    Args:
        recipe: Its `choices` and `settings`.
    """
    old = [*recipe.get("choices", ()), *recipe.get("settings", ())]
    return next(((n, _rename_key(n)) for n in map(str, old) if n in _NAMES), None)


def upgrade(recipe: Mapping[str, Any]) -> dict[str, Any]:
    """Return a checkpoint's recipe with today's names of choices, classes and arguments.

    Args:
        recipe: Its `choices` and `settings`, checked for depth and size.
    """
    choices = {
        _rename_key(group) if "@" in group else group: _choices_of(group).get(choice, choice)
        for group, choice in recipe["choices"].items()
    }
    return {"choices": choices, "settings": _upgrade(recipe["settings"])}


def _upgrade(node: Any, setting: str = "") -> Any:
    if isinstance(node, list):
        return [_upgrade(value) for value in node]
    if not isinstance(node, Mapping):
        return node
    target = rename_class(node.get("_target_")) or node.get("_target_")
    base = BASES.get(setting) if target else None
    out = {}
    for key, value in node.items():
        name = rename_argument(target, str(key)) or rename_argument(base, str(key)) or key
        if name == "loss_weights" and isinstance(value, Mapping):  # in a stage of a training
            value = {_LOSSES.get(loss, loss): factor for loss, factor in value.items()}
        if key == "options" and isinstance(value, Mapping) and _below(target) == _DATA:
            renamed = OPTIONS.get(str(node.get("source")), {})  # a reader of one's own has its own
            both = {old for old, new in renamed.items() if new in value}  # refused by the reader
            value = {n if n in both else renamed.get(n, n): v for n, v in value.items()}
        values = VALUES.get((_below(target), name), {})
        if isinstance(value, str):
            value = values.get(value, value)
        # both names: the old one is refused when the class is built
        own = target if key == "_target_" else _upgrade(value, str(name))
        out[key if name in node else name] = own
    return out


def _below(target: object) -> str:
    """Return a class's place below posefilter."""
    return str(target).removeprefix("posefilter.")


def rename_argument(target: object, name: str) -> str | None:
    """Return what an argument of a class, a `_target_`, is called today; None: as before."""
    return ARGUMENTS.get(_below(target), {}).get(name)


def rename_class(target: object) -> str | None:
    """Return what a class is called today; None where its name has not changed.

    Args:
        target: The class, as `_target_` named it.
    """
    new = CLASSES.get(_below(target))
    return new and f"posefilter.{new}"
