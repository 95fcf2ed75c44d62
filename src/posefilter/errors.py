"""What stands for a user's mistake, which a command tells in a line, and for a wish to stop."""

import math
import unicodedata
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from numbers import Integral, Real
from pathlib import Path
from signal import Signals
from typing import Any

MISTAKE, FAILURE, INTERRUPTED = 2, 1, 130  # exit statuses


def printable(text: str) -> str:
    """Return a text, such as a name in a file of others, with what a terminal would obey rather
    than show as numbers: `\\x1b`, `\\n`, `\\u202e`. Blanks of other scripts stay.
    """
    if text.isprintable():
        return text
    shown = (one.isprintable() or unicodedata.category(one) == "Zs" for one in text)
    return "".join(
        one if plain else one.encode("unicode_escape").decode()
        for one, plain in zip(text, shown, strict=True)
    )


def printable_lines(text: str) -> str:
    """Return a text as `printable` does, with the ends of its lines as they are."""
    return "\n".join(map(printable, text.split("\n")))


class UserError(Exception):
    """A mistake in data, configuration or arguments.

    The message is one line: which file or key, and the likely cause. It holds nothing that a
    terminal obeys: names in files of others are quoted.
    """

    def __str__(self) -> str:
        return printable_lines(super().__str__())


def find_reason(error: BaseException) -> str:
    """Return the first line of an error's message, or its class where there is none."""
    lines = str(error).splitlines()
    return lines[0] if lines else type(error).__name__


@contextmanager
def naming(what: str) -> Iterator[None]:
    """Have the messages of mistakes begin with what they are of, as it was typed."""
    try:
        yield
    except UserError as error:
        raise UserError(f"{what}: {error}") from error


def check_choice(key: str, value: object, *choices: str) -> None:
    """Raise UserError, naming the key, unless a setting is one of its choices."""
    if value not in choices:
        raise UserError(f"{key}={value!r} is unknown: choose {' or '.join(choices)}")


def check_positive(key: str, value: Any) -> None:
    """Raise UserError, naming the key, unless a setting is a number above 0."""
    number = isinstance(value, Real) and not isinstance(value, bool)
    if not (number and 0 < value < math.inf):
        raise UserError(f"{key}={value!r}: must be a positive number")


def check_range(key: str, value: Sequence[float], least: float = -math.inf) -> tuple[float, float]:
    """Return the two ends of a range as numbers.

    Raises UserError, naming the key, unless these are two, the lower first and above `least`.
    """
    if len(value) != 2 or not least < value[0] <= value[1] < math.inf:
        above = "" if least == -math.inf else f" above {least:g}"
        raise UserError(f"{key}={list(value)}: must be two numbers{above}, the lower first")
    return float(value[0]), float(value[1])


def check_seed(seed: object) -> int:
    """Return a seed as Python's own number: numpy's overflow.

    Raises UserError unless it is a whole number, 0 or more.
    """
    if isinstance(seed, bool) or not isinstance(seed, Integral) or seed < 0:
        raise UserError(f"seed={seed!r}: must be a whole number, 0 or more")
    return int(seed)


def missing_package(what: str, package: str, extra: str) -> UserError:
    """Return the error of a package that is not installed.

    Args:
        what: What needs it, as it was typed.
        package: Its name.
        extra: The extra of ours that it belongs to.
    """
    return UserError(
        f"{what}: the package {package} is missing; pip install 'posefilter[{extra}]' (in a clone: "
        f"pip install -e '.[{extra}]')"
    )


class ProblemsFound(UserError):  # noqa: N818
    """A check was done, and something is wrong with what it checked: the commands exit with 1."""


class NotThere(UserError):  # noqa: N818
    """What was looked for is not in the image: the commands exit with 1, as grep does."""


class BadData(UserError):  # noqa: N818
    """A file of a dataset is not as it should be.  `cause` groups the like for counting."""

    def __init__(self, path: Path, cause: str, detail: str = "") -> None:
        super().__init__(path, cause, detail)
        self.path, self.cause, self.detail = path, cause, detail

    def __str__(self) -> str:
        return printable(f"{self.path}: {self.cause}" + f" ({self.detail})" * bool(self.detail))


class Carrier(BaseException):
    """Wraps a mistake, its only argument, on its way through a library that catches `Exception`."""


class Stopped(BaseException):
    """The run was told to stop, by Ctrl-C or by another process.

    Args:
        number: The signal that told it; the command's exit status is 128 more.
    """

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {Signals(number).name}")
        self.number = number
