"""What the pickle within a checkpoint may say: read before it is obeyed.

torch's own reader runs no code of others, and yet a few bytes can have it fill the memory
(`bytearray(10**11)`) or compute for years (the hash of tuples that hold each other twice). What
torch.save writes needs neither.
"""

import pickletools
import re
from typing import Any

from posefilter.errors import UserError

_LARGEST, _MOST_STEPS = 1 << 24, 2_000_000  # bytes of a pickle; steps of it
_HEAVIEST = 100  # values in a tuple, those within its own tuples included
_GLOBALS = re.compile(
    r"torch \w+Storage|torch\.storage (Typed|Untyped)Storage"
    r"|torch\._utils _rebuild_(tensor_v2|parameter)|torch\.nn\.parameter Parameter"
    r"|torch (Size|device|\w*float\w*|\w*int\d+|bool)|torch\.serialization _get_layout"
    r"|torch\._utils _rebuild_sparse_tensor|torch\._utils _rebuild_meta_tensor_no_storage"
    r"|collections (OrderedDict|Counter)|(__builtin__|builtins) set"
)
_LEAVES = (
    *("NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "BINFLOAT", "BINUNICODE"),
    *("SHORT_BINSTRING", "EMPTY_TUPLE", "EMPTY_LIST", "EMPTY_DICT", "GLOBAL"),
)
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_MARK = -1


def check_pickle(data: bytes) -> None:
    """Raise UserError unless a pickle has no more than checkpoints have: plain values, tensors,
    keys that are texts or small numbers, and tuples that are not made of each other.

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
    """Return what no checkpoint has, "" for nothing.  The stack is of weights: the values that a
    value is made of, 1 for what cannot be a key anyway.
    """
    stack: list[int] = []
    memo: dict[Any, int] = {}

    def pop_to_mark() -> list[int]:
        at = len(stack) - 1 - stack[::-1].index(_MARK)
        items = stack[at + 1 :]
        del stack[at:]
        return items

    for number, (code, argument, _) in enumerate(pickletools.genops(data)):
        name = code.name
        if number > _MOST_STEPS:
            return f"more than {_MOST_STEPS:,} steps"
        if name == "GLOBAL" and not _GLOBALS.fullmatch(str(argument)):
            return f"it names {str(argument)[:60]!r}, which no checkpoint needs"
        if name in _LEAVES:
            stack.append(1)
        elif name == "LONG1":
            stack.append(2)  # as a key, it may be one of many of the same hash
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
            stack.append(1 + sum(items))
            if _MARK in items or stack[-1] > _HEAVIEST:
                return f"a tuple of more than {_HEAVIEST} values"
        elif name in ("APPENDS", "SETITEMS"):
            items = pop_to_mark()
            if name == "SETITEMS" and any(key != 1 for key in items[::2]):
                return "a key that is no text or number"
        elif name == "SETITEM":
            _, key = stack.pop(), stack.pop()
            if key != 1:
                return "a key that is no text or number"
        elif name in ("REDUCE", "NEWOBJ"):
            stack.append(stack.pop() + stack.pop())
        elif name == "BINPERSID":
            stack[-1] = 1
        elif name in ("APPEND", "BUILD"):
            stack.pop()
        elif name not in ("PROTO", "STOP"):
            return f"{name}, which torch does not write"
    return ""
