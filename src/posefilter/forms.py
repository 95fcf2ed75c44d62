"""Whether what a file of somebody else holds is of the form that it should have."""

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from posefilter.errors import UserError, printable

MOST = 1e30  # of a number: beyond, sums and charts end in infinity


class Each(NamedTuple):
    """A mapping, any name of which has one form."""

    form: Any


class Record(NamedTuple):
    """A mapping that has all of these names, and may have others."""

    forms: dict[str, Any]


NUMBER, TEXT = "a number", "a text"
_KINDS: dict[str, Callable[[Any], bool]] = {
    NUMBER: lambda value: isinstance(value, int | float) and not isinstance(value, bool),
    TEXT: lambda value: isinstance(value, str),
}


def parse_json(content: bytes | str) -> Any:
    """Parse JSON whose numbers can be computed with.

    Halves of signs, as `ud800` behind a backslash, with which no picture can be drawn, become
    question marks.

    Raises:
        ValueError: It is no JSON, or a number in it is NaN, infinite, or beyond 1e30.
        RecursionError: It is nested too deeply.
    """
    value = json.loads(content, parse_int=_whole, parse_float=_bounded, parse_constant=_bounded)
    text = content if isinstance(content, bytes) else content.encode("utf-8", "replace")
    if rb"\ud" in text.lower():
        value = json.loads(json.dumps(value, ensure_ascii=False).encode("utf-8", "replace"))
    return value


def check_form(value: Any, form: Any, path: Path, place: str = "") -> None:
    """Check content, and all within it that its form tells of.

    Args:
        value: Plain content, as of a JSON file.
        form: NUMBER or TEXT; `[form]`, a list of such; `{name: form}`, a mapping whose names have
            these forms where they are there and not null; `Each` or `Record`.
        path: The file, for messages.
        place: The names that lead to the value in it, joined by dots.

    Raises:
        UserError: Something has another form.
    """
    its = f"{path}: its {place}" if place else f"{path}:"
    if isinstance(form, str):
        if not _KINDS[form](value):
            raise UserError(f"{its} should be {form}, and is {str(value)[:40]!r}")
    elif isinstance(form, list):
        if not isinstance(value, list):
            raise UserError(f"{its} should be a list")
        for number, one in enumerate(value):
            check_form(one, form[0], path, f"{place}[{number}]")
    elif not isinstance(value, Mapping):
        raise UserError(f"{its} should be a mapping")
    else:
        forms = dict.fromkeys(value, form.form) if isinstance(form, Each) else form
        needed = isinstance(form, Record)
        for name, own in (form.forms if needed else forms).items():
            if needed and name not in value:
                raise UserError(f"{its} has no {name}")
            if not isinstance(form, dict) or value.get(name) is not None:
                within = f"{place}.{printable(str(name))}".lstrip(".")
                check_form(value[name], own, path, within)


def _whole(text: str) -> int:
    _bounded(text)
    return int(text)


def _bounded(text: str) -> float:
    number = float(text)
    if not math.isfinite(number) or abs(number) > MOST:
        raise ValueError(f"the number {text[:20]} cannot be computed with")
    return number
