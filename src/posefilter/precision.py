"""What is computed in, whatever the caller has set."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import torch

from posefilter.errors import UserError

_FULL = ("32-true", "32")
_OTHERS = (  # that Lightning's trainer takes
    *("16", "64", "16-true", "16-mixed", "bf16", "bf16-true", "bf16-mixed", "64-true"),
    *("transformer-engine", "transformer-engine-float16"),
)
_P = ParamSpec("_P")
_R = TypeVar("_R")


def in_float32(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function that computes in float32 wherever it is called, or in what it says itself:
    a caller's autocast would put geometry into half precision.

    Raises:
        UserError: When it is called: the default type of tensors is another, in which networks and
            geometry do not fit together.
    """

    @wraps(function)
    def checked(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if torch.get_default_dtype() != torch.float32:
            raise UserError(
                f"torch.set_default_dtype({torch.get_default_dtype()}): posefilter needs "
                "torch.float32"
            )
        with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
            return function(*args, **kwargs)

    return checked


def check_precision(precision: object) -> None:
    """Raise UserError for a trainer's precision that would blur poses, or fit no network, and for
    one that there is not.
    """
    if str(precision) not in (*_FULL, *_OTHERS):
        raise UserError(
            f"trainer.precision={precision}: Lightning has none of this name; leave it at 32-true "
            f"(the others, {', '.join(_OTHERS)}, are refused here)"
        )
    if str(precision) not in _FULL:
        raise UserError(
            f"trainer.precision={precision}: half precision costs a pose millimeters, and double "
            "slows all down; leave it at 32-true (networks take bfloat16 by themselves where that "
            "is fast and safe)"
        )
