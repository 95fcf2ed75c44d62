"""The choices of Hydra's groups, those of plug-ins' folders included, and what each sets."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from hydra import initialize_config_dir
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from posefilter.cli.plain import to_plain
from posefilter.cli.trust import find_folders, trusted
from posefilter.paths import find_conf


class Option(NamedTuple):
    """A choice of a group."""

    group: str
    name: str
    settings: Mapping[str, Any]  # from the root of the whole configuration

    def targets(self) -> dict[str, str]:
        """Return the classes that it names, by place."""
        return dict(list_targets(self.settings, ""))


def list_targets(node: Any, place: str) -> Iterator[tuple[str, str]]:
    """Yield (place, name) of each `_target_` in a node of plain settings, outer ones first."""
    for at, value in list_places(node, place):
        if at.endswith("._target_") and isinstance(value, str):
            yield at.removesuffix("._target_"), value


def list_places(node: Any, place: str) -> Iterator[tuple[str, Any]]:
    """Yield (place, value) of each value in a node of plain settings that is not a mapping with
    keys, outer ones first.
    """
    if isinstance(node, Mapping) and node:
        for key, value in sorted(
            node.items(), key=lambda pair: isinstance(pair[1], Mapping | list)
        ):
            yield from list_places(value, f"{place}.{key}" if place else str(key))
    elif isinstance(node, list) and node:
        for i, value in enumerate(node):
            yield from list_places(value, f"{place}[{i}]")
    else:
        yield place, node


class Groups:
    """Reads choices of groups, each once.

    Args:
        loader: Hydra's.
    """

    def __init__(self, loader: Any) -> None:
        self._loader = loader
        self.load = cache(self._load)

    def list_options(self, group: str) -> list[Option]:
        """Read all choices of a group."""
        # not the loader's own get_group_options, which copies every file that it has read
        names = self._loader.repository.get_group_options(group.partition("@")[0])
        options = []
        for name in names:
            with suppress(HydraException, OmegaConfBaseException, YAMLError):  # an unreadable draft
                options += [] if name.startswith("_") else [self.load(group, name)]
        return options

    def _load(self, group: str, name: str) -> Option:
        """Read one choice, with the files of its own group that it starts from."""
        folder, _, package = str(group).partition("@")
        found = self._loader.repository.load_config(f"{folder}/{name}")
        if found is None:
            return Option(group, name, {})
        node = to_plain(found.config)
        package = package or found.header.get("package") or "_group_"
        package = folder.replace("/", ".") if package == "_group_" else package
        settings: dict[str, Any] = {}
        for base in node.pop("defaults", None) or []:
            if isinstance(base, str) and base != "_self_":
                start = base.partition("@")[0].removeprefix(f"/{folder}/")
                settings = _merge(settings, self.load(f"{folder}@{package}", start).settings)
        for key in reversed([] if package == "_global_" else package.split(".")):
            node = {key: node}
        return Option(group, name, _merge(settings, node))


def _merge(old: Any, new: Any) -> Any:
    if not (isinstance(old, Mapping) and isinstance(new, Mapping)):
        return new
    return {**old, **{k: _merge(old[k], v) if k in old else v for k, v in new.items()}}


class PluginFolders(SearchPathPlugin):
    """Has Hydra look for choices in the folder `conf` of packages that the user trusts, too: after
    the project's own.
    """

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Add the folders."""
        for folder in find_folders(trusted()):
            search_path.append("posefilter.plugins", f"file://{folder}")


def add_plugin_folders() -> None:
    """Have Hydra find the choices of plug-ins in all that it composes from now on."""
    Plugins.instance().register(PluginFolders)


@contextmanager
def open_settings(conf: Path) -> Iterator[None]:
    """Have Hydra compose from a folder and plug-ins, unless a command is running: then from its."""
    add_plugin_folders()
    running = GlobalHydra.instance().is_initialized()
    with (
        nullcontext() if running else initialize_config_dir(str(conf.resolve()), version_base="1.3")
    ):
        yield


@contextmanager
def open_groups() -> Iterator[Groups]:
    """Yield the groups of the running command, else of the project's own folder and plug-ins."""
    with open_settings(find_conf()):
        yield Groups(GlobalHydra.instance().config_loader())
