"""A component that is made in Python is the one that its configuration file makes."""

import importlib
import inspect
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
from omegaconf import OmegaConf

CONF = Path(__file__).parents[2] / "conf"
# Files choose another value for a reason of their own: a chain's parts differ from each other, a
# sharper likelihood was fitted, or a loss is to be cheap.
OTHERS = {
    ("Gradient", "sigma"), ("Gradient", "lr"), ("ResampleMove", "sweeps"),
    ("ResampleMove", "temperature"), ("ImportanceSampling", "temperature"),
    ("ImportanceSampling", "widening"), ("AddS", "points"),
}  # fmt: skip


def list_components(node: Any) -> list[dict[str, Any]]:
    """Return every mapping with a `_target_`, however deep."""
    if isinstance(node, list):
        return [found for one in node for found in list_components(one)]
    if not isinstance(node, dict):
        return []
    own = [node] if isinstance(node.get("_target_"), str) else []
    return own + [found for one in node.values() for found in list_components(one)]


def read_settings() -> dict[str, dict[str, set[float]]]:
    """Return the numbers that files give to each class of filters and losses."""
    found: dict[str, dict[str, set[float]]] = {}
    for file in sorted(CONF.rglob("*.yaml")):
        for component in list_components(OmegaConf.to_container(OmegaConf.load(file))):
            target = component["_target_"]
            if target.startswith(("posefilter.filters.", "posefilter.losses.")):
                numbers = found.setdefault(target, {})
                for name, value in component.items():
                    if type(value) in (int, float):
                        numbers.setdefault(name, set()).add(value)
    return found


SETTINGS = read_settings()


@pytest.mark.parametrize("target", SETTINGS)
def test_defaults_are_those_of_the_files(target: str) -> None:
    module, name = target.rsplit(".", 1)
    kind = getattr(importlib.import_module(module), name)
    needed = {
        parameter.name: min(SETTINGS[target].get(parameter.name, ())) or 1
        if parameter.name in SETTINGS[target]
        else MagicMock()
        for parameter in inspect.signature(kind).parameters.values()
        if parameter.default is parameter.empty
        and parameter.kind is parameter.POSITIONAL_OR_KEYWORD
    }
    if name != "ParticleFilter":  # a module takes no mocks, and has no numbers of its own
        kind(**needed)
    for parameter in inspect.signature(kind).parameters.values():
        given = SETTINGS[target].get(parameter.name)
        if (
            given
            and type(parameter.default) in (int, float)
            and (name, parameter.name) not in OTHERS
        ):
            assert parameter.default in given, parameter.name
