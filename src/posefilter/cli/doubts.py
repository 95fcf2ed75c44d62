"""Say, once a kind, what makes answers about many images doubtful."""

import re
from collections.abc import Sequence
from typing import Any

from posefilter.cli.console import warn
from posefilter.result import Result


def _drop_numbers(text: str) -> str:
    """Return what kind of reason a text is of: numbers do not tell kinds apart."""
    return re.sub(r"[\d.]+", "", text)


def say_doubt(result: Result, image: str, warned: set[str], console: str, **facts: Any) -> None:
    """Warn of a result whose depth or intrinsics must be wrong, or whose image cannot be judged.

    Args:
        result: The result.
        image: Which image it is of, as in "frame 000001".
        warned: Objects and reasons that were warned of before, and are not again; more are added.
        console: Where to.
        facts: More, for machines.
    """
    doubt = _drop_numbers(result.blank) or (result.object if result.wrong_size else "")
    if doubt and doubt not in warned:
        warned.add(doubt)
        facts |= {"object": result.object, "warnings": list(result.warnings)}
        warn(console, f"{image}: {'; '.join(result.warnings)}", **facts)


def say_commonest(
    name: str, where: str, warnings: Sequence[str], images: int, unit: str, console: str
) -> None:
    """Say the commonest kind of warning about an object that was found nowhere; numbers do not tell
    kinds apart.

    Args:
        name: The object.
        where: Where it was not found, as in "is in no image".
        warnings: All that there are; where there are none, nothing is said.
        images: How many images there were.
        unit: What these are called for machines.
        console: Where to.
    """
    kinds: dict[str, list[str]] = {}
    for warning in warnings:
        kinds.setdefault(_drop_numbers(warning), []).append(warning)
    if most := max(kinds.values(), key=len, default=None):
        said, facts = f"{name} {where}; in {len(most)} of {images} {most[0]}", {unit: len(most)}
        warn(console, said, object=name, **facts, reason=most[0])
