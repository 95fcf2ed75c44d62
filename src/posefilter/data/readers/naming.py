"""Find the classes that a user names among those that a dataset has."""

import difflib
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from posefilter.errors import UserError

_BOP_NAME = re.compile(r"(?:obj_?)?0*([0-9]{1,6})")  # of one who leaves out what pads it


def choose_objects(
    wanted: str | Sequence[str] | None,
    known: Sequence[str],
    root: Path,
    strip: Callable[[str], str] = str,
    broken: str = "",
) -> tuple[str, ...]:
    """Return the wanted classes as the dataset spells them; None: all.

    Args:
        wanted: The classes as typed.
        known: Those that the dataset has.
        root: Its folder.
        strip: Takes off what may be typed beyond a class's name.
        broken: What is wrong with a file that was left out, where one was.

    Raises:
        UserError: A wanted class is not known.
    """
    if wanted is None:
        return tuple(known)
    several = isinstance(wanted, Sequence) and not isinstance(wanted, str)
    listed = wanted if several else [wanted]  # a single name may read as a number
    names = tuple(strip(str(name)) for name in listed)
    if names and broken and not known:
        raise UserError(f"{broken}; no image is left that could show '{names[0]}' (data.object)")
    for name in names:
        if name not in known:
            number = _BOP_NAME.fullmatch(name)
            meant = f"obj_{int(number[1]):06d}" if number else ""
            near = [meant] if meant in known else []
            near = near or difflib.get_close_matches(name, known, n=1, cutoff=0.5)
            hint = f"did you mean '{near[0]}'?" if near else f"it has {', '.join(known) or 'none'}"
            hint += f"; left out: {broken}" if broken else ""
            raise UserError(f"{root}: unknown class '{name}' (data.object): {hint}")
    if not names:
        raise UserError(f"{root}: data.object is an empty list: name a class")
    return names


def choose_several(name: str, asked: object, known: Sequence[str]) -> tuple[str, ...]:
    """Return the choices that an option of a reader names, one or several.

    Raises UserError, naming the option, for anything else.
    """
    several = (asked,) if isinstance(asked, str) else asked
    right = isinstance(several, Sequence) and several and all(one in known for one in several)
    if not right:
        raise UserError(f"data.options.{name}={asked}: choose one or more of {', '.join(known)}")
    return tuple(several)  # type: ignore[arg-type]


def need_text(name: str, asked: object) -> None:
    """Raise UserError where an option of a reader that names a folder or file is something else."""
    if asked is not None and not isinstance(asked, str | Path):
        raise UserError(f"data.options.{name}={asked}: must be a name, or null")
