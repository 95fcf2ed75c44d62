"""Settings as plain data."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf


def to_plain(cfg: DictConfig) -> dict[str, Any]:
    """Return settings by name, their interpolations as they are written."""
    plain = OmegaConf.to_container(cfg, resolve=False)
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items()}


def map_values(node: Any, change: Callable[[Any, str], Any], place: str = "") -> Any:
    """Return plain settings with other values.

    Args:
        node: The settings.
        change: Given a value that is no mapping or list, and its place; returns the new value.
        place: The node's, such as `filter.refine.components[0]`.
    """
    if isinstance(node, dict):
        return {
            key: map_values(value, change, f"{place}.{key}" if place else str(key))
            for key, value in node.items()
        }
    if isinstance(node, list):
        return [map_values(value, change, f"{place}[{i}]") for i, value in enumerate(node)]
    return change(node, place)


def walk(node: Any) -> Iterator[tuple[str, int, Any]]:
    """Yield (path, depth, value) of every node, itself first, lazily and without recursion."""
    stack = [("", 0, node)]
    while stack:
        path, depth, value = stack.pop()
        yield path, depth, value
        if isinstance(value, Mapping):
            stack += [
                (f"{path}.{key}" if isinstance(key, str) else f"{path}.?", depth + 1, v)
                for key, v in value.items()
            ]
        elif isinstance(value, list | tuple | set):
            stack += [(f"{path}[{i}]", depth + 1, v) for i, v in enumerate(value)]


def key_of(override: str) -> str:
    """Return the setting or group that a typed override is of."""
    return override.partition("=")[0].lstrip("+~")


def find(node: Any, path: str) -> Any:
    """Return what nested settings hold at a dotted path, in lists by number; None for nothing."""
    for key in path.split("."):
        if isinstance(node, list):
            try:
                node = node[int(key)]
            except (ValueError, IndexError):
                return None
        else:
            node = node.get(key) if isinstance(node, Mapping) else None
    return node


def resolve(node: Any) -> Any:
    """Return a part of the settings with what it refers to."""
    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node


def unresolved(node: Any) -> Any:
    """Return a part of the settings as it is written."""
    return OmegaConf.to_container(node, resolve=False) if OmegaConf.is_config(node) else node
