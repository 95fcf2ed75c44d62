"""Where Hydra looks for choices: also in the folder `conf` of packages that the user trusts."""

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin

from posefilter.cli.trust import find_folders, trusted


class PluginFolders(SearchPathPlugin):
    """Adds the choices of plug-ins after the project's own."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Add the folders."""
        for folder in find_folders(trusted()):
            search_path.append("posefilter.plugins", f"file://{folder}")


def add_plugin_folders() -> None:
    """Have Hydra find the choices of plug-ins in all that it composes from now on."""
    Plugins.instance().register(PluginFolders)
