"""What a command is asked to do."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig


@dataclass(frozen=True)
class Job:
    """One run of one command."""

    cfg: DictConfig
    choices: dict[str, str]  # which file of each group
    overrides: list[str]  # as typed
    folder: Path  # where its files go
    name: str  # of the command
    swept: bool  # one of several that `-m` started


def first(*values: Any) -> Any:
    """Return the first value that is not null."""
    return next((value for value in values if value is not None), None)


def plain_name(text: str) -> str:
    """Return a text fit for a folder's name: no slashes, no Hydra signs, at most 120 characters."""
    return re.sub(r"[^\w.,=\-]+", "_", re.sub(r"(^|,)[+~]+", r"\1", str(text))).strip("_")[:120] or "run"
