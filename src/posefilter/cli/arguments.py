"""What is typed, made into what Hydra reads; torch is not needed for it."""

import re
from collections.abc import Sequence
from pathlib import Path

from posefilter.errors import UserError

_FOLDERS = ("run", "runs", "sweep", "out")  # of a report


def bracketed(arguments: list[str]) -> list[str]:
    """Put brackets round the plain lists that some settings take: intrinsics=1,2,3,4 is four
    numbers, not a sweep.
    """
    return [
        re.sub(
            r"^((?:\w+\.)*(?:intrinsics|camera|size))=([^\[\],]+(?:,[^\[\],]+)+)$", r"\1=[\2]", a
        )
        for a in arguments
    ]


def check_choices(arguments: list[str], conf: Path) -> None:
    """Raise UserError where a group is given a value instead of the name of one of its files: Hydra
    stumbles over it.
    """
    for argument in arguments:
        group, _, value = argument.partition("=")
        if value.startswith(("[", "{")) and re.fullmatch(r"\w+", group) and (conf / group).is_dir():
            options = sorted(file.stem for file in (conf / group).glob("*.yaml"))
            there = f"there are {', '.join(options)}" if options else f"see conf/{group}"
            raise UserError(f"{group}={value}: takes the name of a choice, not a value; {there}")


def spelled(arguments: Sequence[str]) -> list[str]:
    """Return the command line as Hydra reads it: `sweep` is a group of its own, and folders may
    have `=` and `,` in them.
    """
    out = []
    for argument in arguments:
        key, found, value = argument.partition("=")
        if found and key in _FOLDERS and value and value[0] not in "'\"" and value != "null":
            value = "'" + value.replace("'", "\\'") + "'"
        out.append(f"{'sweep_folder' if key == 'sweep' else key}{found}{value}")
    return out
