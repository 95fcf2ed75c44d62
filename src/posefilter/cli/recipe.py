"""A checkpoint's recipe is data that others may have written: check it before anything is made of
it.

Its settings may refer to each other (`${filter}`), and that is all: no other interpolation is
resolved, so that a recipe can neither read the environment nor call a function. It is small, and
its numbers are such as methods have.
"""

import math
import re
import unicodedata
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from posefilter.cli.plain import find, map_values, resolve, walk
from posefilter.cli.renamed import find_renamed, upgrade
from posefilter.cli.trust import DATA_NAMES, is_plugin
from posefilter.errors import UserError
from posefilter.paths import stays_inside

NOT_KEPT = (
    *("warm_start", "out", "folder", "trainer", "callbacks", "logger", "resume", "debug"),
    *("console", "plugins", "tags", "hydra"),
)
# a setting of posefilter's own networks that names a file to start a training from: the checkpoint
# has what came of it
_PRETRAINED = "weights"
_DEEPEST, _MOST_NODES, _LONGEST = 16, 20_000, 1000
MOST_WHOLE = 1_000_000  # a setting that is a whole number; none may be less than its range allows
LIMITS = {
    "seed": 1 << 63,
    "split_seed": 1 << 63,
    "workers": 256,
    "frames": 10_000_000,
    "warmup_steps": 10**12,
    "particles": 100_000,
    "initial_particles": 100_000,
}
_KEY = re.compile(r"[\w./@#-]{1,100}")
_REFERENCE = re.compile(r"\$\{([A-Za-z_]\w*(?:\.\w+)*)\}")
_SELECT = re.compile(r"\$\{oc\.select:([A-Za-z_]\w*(?:\.\w+)*),(-?\d{1,6}|null)\}")


def calls_resolver(value: str) -> bool:
    """Tell whether a setting has an interpolation that is no reference to another setting."""
    return "${" in _REFERENCE.sub("", value)


def resolve_foreign(settings: dict[str, Any]) -> dict[str, Any]:
    """Return settings with every interpolation but references resolved, as a recipe has them."""
    tree = OmegaConf.create(settings)

    def resolve_value(value: Any, place: str) -> Any:
        foreign = isinstance(value, str) and calls_resolver(value)
        return resolve(OmegaConf.select(tree, place)) if foreign else value

    return dict(map_values(settings, resolve_value))


def check_recipe(recipe: Any) -> dict[str, Any]:
    """Return a recipe that is safe to build from, without what it must not decide.

    Args:
        recipe: What the checkpoint holds under that name.

    Raises:
        UserError: It is no recipe, too large, or holds an interpolation that is no reference to
            another of its settings.
    """
    if not (isinstance(recipe, dict) and set(recipe) == {"choices", "settings"}):
        raise UserError("its recipe should hold choices and settings, nothing else")
    choices, settings = recipe["choices"], recipe["settings"]
    if not (isinstance(choices, dict) and isinstance(settings, dict)):
        raise UserError("its recipe's choices and settings should be mappings")
    foreign = sorted(str(key) for key in settings if key in NOT_KEPT)
    if foreign:
        raise UserError(f"its recipe holds {foreign[0]}, which a checkpoint does not decide")
    for count, (path, depth, value) in enumerate(walk(recipe)):
        if depth > _DEEPEST:
            raise UserError(f"its recipe is nested more than {_DEEPEST} deep")
        if count > _MOST_NODES:
            raise UserError(f"its recipe holds more than {_MOST_NODES} settings")
        _check_value(path, value)
    old = find_renamed(recipe)
    if old is not None:
        raise UserError(
            f"was written by an earlier version ({old[0]} is now {old[1]}); train it again"
        )
    if not all(isinstance(choice, str) and _KEY.fullmatch(choice) for choice in choices.values()):
        raise UserError("its recipe's choices should be names")
    now = upgrade(recipe)
    settings = _without_selects(now["settings"])
    _check_expansion(settings)
    return {"choices": now["choices"], "settings": settings}


def without_pretrained(node: Any) -> Any:
    """Return settings that name no file of weights: those of the checkpoint take their place.

    What a plug-in calls `weights` may be anything, and stays.
    """
    if isinstance(node, dict):
        plain = {key: without_pretrained(value) for key, value in node.items()}
        own = _PRETRAINED in node and str(node.get("_target_")).startswith("posefilter.")
        return plain | {_PRETRAINED: None} if own else plain
    return [without_pretrained(value) for value in node] if isinstance(node, list) else node


def check_data(data: Mapping[str, Any], typed: Mapping[str, Any]) -> None:
    """Raise UserError where settings of the data, of a recipe, name what only the user may.

    A recipe's own folders count below the working folder alone: one that is there, or one below
    `outputs`, where scenes may be rendered. Any other is to be typed.

    Args:
        data: The settings, resolved.
        typed: The values that the user typed, by key, such as `root`.
    """
    own = set(map(str, typed.values()))
    for path, _, value in walk(data):
        key = path.lstrip(".")
        if (
            key.rpartition(".")[2] == "_target_"
            and value not in DATA_NAMES
            and not is_plugin(str(value))
        ):
            raise UserError(
                f"data.{key}={value!r}: may not be built from a checkpoint; choose "
                f"data=... yourself"
            )
        if not isinstance(value, str) or key in typed or value in own or key.endswith("_target_"):
            continue
        place = key in ("root", "cache_dir") or key.endswith("out")
        absent = place and not (Path("outputs") in Path(value).parents or Path(value).is_dir())
        inside = stays_inside(value, Path())
        if absent and inside and key == "root":
            raise UserError(no_own_folder(key, value))
        if absent or not inside:
            raise UserError(
                f"data.{key}={value}: a checkpoint decides on no such place; if it is right, type "
                f"data.{key}={value}"
            )
    if data.get("cache") == "disk" and "cache" not in typed:
        raise UserError(
            "data.cache=disk: a checkpoint does not decide where frames are kept; type "
            "data.cache=disk or memory"
        )


def no_own_folder(key: str, folder: str) -> str:
    """Return the line on a folder of a checkpoint's own data that is not there.

    Args:
        key: `root` or `meshes`.
        folder: What the checkpoint says.
    """
    relative = ", relative to where it was trained" if not Path(folder).is_absolute() else ""
    return (
        f"data.{key}={folder}: no such folder here; it is the checkpoint's own{relative}: type "
        f"data.{key}=DIR, or choose another dataset, data=... data.root=DIR"
    )


def _check_value(path: str, value: Any) -> None:
    where = path.lstrip(".").removeprefix("settings.")[:100]
    if isinstance(value, dict):
        wrong = [key for key in value if not (isinstance(key, str) and _KEY.fullmatch(key))]
        if wrong:
            raise UserError(f"its recipe has the key {str(wrong[0])[:40]!r}")
    elif isinstance(value, str):
        # blanks of other scripts are no signs that a terminal obeys
        if len(value) > _LONGEST or not all(
            one.isprintable() or unicodedata.category(one) == "Zs" for one in value
        ):
            raise UserError(f"its recipe's {where} is no plain text of at most {_LONGEST} letters")
        # a select stands alone: within a text, nobody would see what it refers to
        if calls_resolver(value) and not _SELECT.fullmatch(value):
            raise UserError(
                f"its recipe's {where}={value[:60]!r} may only refer to another setting, such as "
                "${filter}"
            )
    elif isinstance(value, int) and not isinstance(value, bool):
        if abs(value) > LIMITS.get(where.rpartition(".")[2], MOST_WHOLE):
            raise UserError(f"its recipe's {where}={str(value)[:30]} is too large")
    elif isinstance(value, float):
        if not math.isfinite(value):
            raise UserError(f"its recipe's {where}={value} is not finite")
    elif not (value is None or isinstance(value, bool | list)):
        raise UserError(
            f"its recipe's {where} is a {type(value).__name__}; only plain settings may stand there"
        )


def _without_selects(settings: dict[str, Any]) -> dict[str, Any]:
    """Return settings with `${oc.select:a.b,0}`, of older checkpoints, as a reference to a.b, or 0
    where there is none.
    """

    def refer(value: Any, _: str) -> Any:
        found = _SELECT.fullmatch(value) if isinstance(value, str) else None
        if found is None:
            return value
        if find(settings, found[1]) is not None:
            return f"${{{found[1]}}}"
        return None if found[2] == "null" else int(found[2])

    return dict(map_values(settings, refer))


def _check_expansion(settings: dict[str, Any]) -> None:
    """Raise UserError where references would never end, or grow out of bounds."""
    stack, count = [(0, settings)], 0
    while stack:
        depth, node = stack.pop()
        count += 1
        if depth > 4 * _DEEPEST or count > 10 * _MOST_NODES:
            raise UserError("its recipe's settings refer to each other without end")
        if isinstance(node, dict | list):
            inner = node.values() if isinstance(node, dict) else node
            stack += [(depth + 1, value) for value in inner]
        elif isinstance(node, str):
            stack += [(depth + 1, find(settings, name)) for name in _REFERENCE.findall(node)]
