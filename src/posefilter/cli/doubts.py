"""Say, once a kind, what makes answers about many images doubtful."""

import re
from collections.abc import Sequence
from typing import Any

from posefilter.cli.console import say
from posefilter.result import Result


def say_doubt(result: Result, image: str, warned: set[str], console: str, **facts: Any) -> None:
    """Warn of a result whose depth or intrinsics must be wrong, or whose image cannot be judged.

    Args:
        result: The result.
        image: Which image it is of, as in "frame 000001".
        warned: Objects and reasons that were warned of before, and are not again; more are added.
        console: Where to.
        facts: More, for machines.
    """
    doubt = result.blank or (result.object if result.wrong_size else "")
    if doubt and doubt not in warned:
        warned.add(doubt)
        said = f"warning: {image}: {'; '.join(result.warnings)}"
        facts |= {"object": result.object, "warnings": list(result.warnings)}
        say(console, "warning", said, **facts)


def find_commonest(warnings: Sequence[str]) -> tuple[str, int] | None:
    """Return the first of the commonest kind of warning, and how many there are; numbers do not
    tell kinds apart. None: there are none.
    """
    kinds: dict[str, list[str]] = {}
    for warning in warnings:
        kinds.setdefault(re.sub(r"[\d.]+", "", warning), []).append(warning)
    most = max(kinds.values(), key=len, default=None)
    return None if most is None else (most[0], len(most))
