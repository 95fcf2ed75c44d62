"""What the pickle within a checkpoint may say: read before it is obeyed.

torch's own reader runs no code of others, and yet a few bytes can have it fill the memory
(`bytearray(10**11)`, a set made again and again of one list) or compute for years (the hash of
tuples that hold each other twice). What torch.save writes needs neither.
"""

import pickletools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from posefilter.errors import UserError

_LARGEST, _MOST_STEPS = 1 << 24, 2_000_000  # bytes of a pickle; steps of it
_HEAVIEST = 100  # values in a tuple, those within its own tuples included
_MOST_GIVEN = 10_000  # items of lists and dicts that functions are given, all together
_CALLED = re.compile(
    r"torch\._utils _rebuild_(tensor_v2|parameter|sparse_tensor|meta_tensor_no_storage)"
    r"|torch\.nn\.parameter Parameter|torch (Size|device)|torch\.serialization _get_layout"
    r"|collections (OrderedDict|Counter)|(__builtin__|builtins) set"
)
_NAMED = re.compile(
    r"torch (?!Q)\w+Storage|torch\.storage (Typed|Untyped)Storage|torch (\w*float\w*|u?int\d+|bool)"
)
_LEAVES = (
    *("NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "BINFLOAT", "BINUNICODE"),
    *("SHORT_BINSTRING", "EMPTY_TUPLE", "EMPTY_LIST", "EMPTY_DICT", "GLOBAL"),
)
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_ATTRIBUTES = {"_metadata"}  # that torch gives a state_dict


@dataclass(slots=True, eq=False)
class _Value:
    """What a pickle has made so far, as far as it decides what it costs to use it."""

    weight: int = 1  # values that it is made of; 1 for what cannot be a key anyway
    text: str | None = None  # what a text says, or what a name names
    parts: "Sequence[_Value]" = ()  # of a tuple
    holds: bool = False  # whether it is a list or dict
    count: int = 0  # items of one
    plain: bool = True  # whether those of a list are texts and small numbers
    keys: set[str | None] | None = None  # of a dict

    def add(self, items: "Sequence[_Value]") -> None:
        """Count items of a list."""
        self.count += len(items)
        self.plain = self.plain and all(item.weight == 1 and not item.holds for item in items)

    def add_pairs(self, items: "Sequence[_Value]") -> None:
        """Count keys, each with a value, of a dict."""
        self.count += len(items) // 2
        if self.keys is not None:
            self.keys |= {key.text for key in items[::2]}


_MARK = _Value()


def check_pickle(data: bytes) -> None:
    """Raise UserError unless a pickle has no more than checkpoints have: plain values, tensors,
    keys that are texts or small numbers, tuples that are not made of each other, and few and small
    collections that functions are called with.

    Args:
        data: The pickle.
    """
    if len(data) > _LARGEST:
        raise UserError(f"what it says of itself is {len(data):,} bytes, at most {_LARGEST:,}")
    try:
        flaw = _find_flaw(data)
    # the bytes decide what breaks: an empty stack, a mark that is not there, a cut argument
    except (ValueError, IndexError, KeyError, TypeError) as error:
        raise UserError("not readable as a checkpoint (a broken pickle)") from error
    if flaw:
        raise UserError(f"not readable as a checkpoint ({flaw})")


def _find_flaw(data: bytes) -> str:
    """Return what no checkpoint has, "" for nothing."""
    stack: list[_Value] = []
    memo: dict[Any, _Value] = {}
    given = 0

    def pop_to_mark() -> list[_Value]:
        at = len(stack) - 1
        while stack[at] is not _MARK:  # without one, an IndexError
            at -= 1
        items = stack[at + 1 :]
        del stack[at:]
        return items

    for number, (code, argument, _) in enumerate(pickletools.genops(data)):
        name = code.name
        if number > _MOST_STEPS:
            return f"more than {_MOST_STEPS:,} steps"
        text = argument if isinstance(argument, str) else None
        if name == "GLOBAL" and not (_CALLED.fullmatch(str(text)) or _NAMED.fullmatch(str(text))):
            return f"it names {str(text)[:60]!r}, which no checkpoint needs"
        if name in _LEAVES:
            keys: set[str | None] | None = set() if name == "EMPTY_DICT" else None
            holds = name in ("EMPTY_LIST", "EMPTY_DICT")
            stack.append(_Value(text=text, keys=keys, holds=holds))
        elif name == "LONG1":
            stack.append(_Value(2))  # as a key, it may be one of many of the same hash
        elif name == "MARK":
            stack.append(_MARK)
        elif name in ("BINPUT", "LONG_BINPUT"):
            memo[argument] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            stack.append(memo[argument])
        elif name == "TUPLE" or name in _TUPLES:
            items = (
                pop_to_mark() if name == "TUPLE" else [stack.pop() for _ in range(_TUPLES[name])]
            )
            stack.append(_Value(1 + sum(item.weight for item in items), parts=items))
            if _MARK in items or stack[-1].weight > _HEAVIEST:
                return f"a tuple of more than {_HEAVIEST} values"
        elif name in ("APPEND", "APPENDS"):
            items = [stack.pop()] if name == "APPEND" else pop_to_mark()
            stack[-1].add(items)
        elif name in ("SETITEM", "SETITEMS"):
            items = [stack.pop(), stack.pop()][::-1] if name == "SETITEM" else pop_to_mark()
            if any(key.weight != 1 for key in items[::2]):
                return "a key that is no text or number"
            stack[-1].add_pairs(items)
        elif name in ("REDUCE", "NEWOBJ"):
            values, function = stack.pop(), stack.pop()
            if not _CALLED.fullmatch(function.text or ""):
                return f"it calls {str(function.text)[:60]!r}, which no checkpoint needs"
            collections = [value for value in _list_parts(values) if value.count]
            given += sum(value.count for value in collections)
            if given > _MOST_GIVEN or not all(value.plain for value in collections):
                return "a function is given a collection larger or deeper than checkpoints have"
            stack.append(_Value(values.weight + function.weight))
        elif name == "BUILD":
            state = stack.pop()
            if state.keys is None or not state.keys <= _ATTRIBUTES:
                return "a dict with attributes of its own"
        elif name == "BINPERSID":
            stack[-1] = _Value()
        elif name not in ("PROTO", "STOP"):
            return f"{name}, which torch does not write"
    return ""


def _list_parts(value: _Value) -> list[_Value]:
    """Return a value, the parts of a tuple, and theirs."""
    return [value, *(one for part in value.parts for one in _list_parts(part))]
