"""Public names of a package that are imported when they are first used (PEP 562)."""

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def import_lazily(
    package: str, homes: Mapping[str, str], convert: Callable[[Any], Any] | None = None
) -> Callable[[str], Any]:
    """Return a package's `__getattr__`.

    Args:
        package: Its name.
        homes: The module below it that defines each name; a name that is its own home is a module.
        convert: Makes what is returned of what a module defines.
    """

    def find(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        module = importlib.import_module(f"{package}.{homes[name]}")
        value = module if homes[name] == name else getattr(module, name)
        return value if convert is None else convert(value)

    return find
