"""Fixtures shared by every test."""

import importlib.util
import logging
import os
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import hydra._internal.defaults_list
import omegaconf._utils
import pytest
import torch
import yaml
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from posefilter.progress import bars


@pytest.fixture(autouse=True)
def seeded() -> None:
    """Let every test draw the same numbers each time, and whatever ran before it."""
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def leave_no_log_handlers() -> Iterator[None]:
    """Take out of the log what a command put there: its handlers write to the streams of the test
    that ran it, which are closed when the next one logs.
    """
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    yield
    for handler in [one for one in root.handlers if one not in handlers]:
        root.removeHandler(handler)
    root.setLevel(level)


@pytest.fixture(scope="session", autouse=True)
def parse_settings_by_libyaml() -> Iterator[None]:
    """Let OmegaConf's own YAML loader be libyaml's, where there is one: a third of the time that a
    composition takes is parsing, and the suite composes hundreds.
    """
    with pytest.MonkeyPatch.context() as patch:
        if yaml.__with_libyaml__:
            with pytest.MonkeyPatch.context() as base:
                base.setattr(yaml, "SafeLoader", yaml.CSafeLoader)
                loader = omegaconf._utils.get_yaml_loader()
            patch.setattr(omegaconf._utils, "get_yaml_loader", lambda: loader)
        yield


@pytest.fixture(scope="session", autouse=True)
def composing_by_hydra_alone() -> Iterator[Callable[[pytest.MonkeyPatch], None]]:
    """Spare compositions three steps of Hydra whose outcome is not used, or known, two thirds of
    their time: a copy of the store of choices, which is one for the process and whose entries are
    copied when they are read, all choices as a tree for a list of defaults that interpolates none,
    and reading again the fifty files of a composition, most of which others share.

    Yields:
        What takes a patch, and brings the steps back for as long as the patch holds.
    """
    make = hydra._internal.defaults_list._create_interpolation_map
    load = OmegaConf.load
    pickled: dict[str, bytes] = {}

    def make_if_used(overrides: Any, defaults: list[Any], self_added: bool) -> Any:
        if any(one.is_interpolation() for one in defaults):
            return make(overrides, defaults, self_added)
        return None

    def load_once(file: Any) -> Any:
        """Make nodes again from a pickle: it takes a seventeenth of the time."""
        if not hasattr(file, "read"):
            return load(file)
        text = file.read()
        if text not in pickled:
            file.seek(0)
            pickled[text] = pickle.dumps(load(file))
        return pickle.loads(pickled[text])

    def bring_back(patch: pytest.MonkeyPatch) -> None:
        patch.delattr(ConfigStore, "__deepcopy__")
        patch.setattr(hydra._internal.defaults_list, "_create_interpolation_map", make)
        patch.setattr(OmegaConf, "load", load)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ConfigStore, "__deepcopy__", lambda store, memo: store, raising=False)
        patch.setattr(hydra._internal.defaults_list, "_create_interpolation_map", make_if_used)
        patch.setattr(OmegaConf, "load", load_once)
        yield bring_back


@pytest.fixture
def bar_tasks(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], list[Any]]:
    """Given where a command has `bars`: the tasks that it shows, filled in when it ends."""

    def keep(name: str) -> list[Any]:
        seen: list[Any] = []

        @contextmanager
        def watch(**_: Any) -> Iterator[Any]:
            with bars(shown=False) as bar:
                yield bar
                seen.extend(bar.tasks)

        monkeypatch.setattr(name, watch)
        return seen

    return keep


@pytest.fixture(scope="session")
def load_script() -> Callable[[str], ModuleType]:
    """Return a function that imports a script outside the package, by its path in the project;
    what lies beside it can be imported, as when it is run.
    """

    def load(path: str) -> ModuleType:
        file = Path(__file__).parents[1] / path
        spec = importlib.util.spec_from_file_location(file.stem, file)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.path.insert(0, str(file.parent))
        try:
            spec.loader.exec_module(module)
        finally:
            sys.path.remove(str(file.parent))
        return module

    return load


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Return the folder of real frames and meshes, or skip: users of the project do not have it."""
    root = Path(os.environ.get("POSEFILTER_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not root.is_dir():
        pytest.skip(
            f"no real data at {root}: set POSEFILTER_DATA to a folder with ycb/, ycbv/ and fat/"
        )
    return root
