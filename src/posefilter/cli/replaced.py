"""Mappings that the command line replaces whole, where Hydra would merge them with the defaults."""

from collections.abc import Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf, open_dict

WHOLE = ("data.split",)


def replace_typed(cfg: DictConfig, overrides: Sequence[str]) -> None:
    """Keep of each mapping in `WHOLE` only what was typed, once it was typed whole.

    `data.split={test: 1.0}` means that and nothing else: the default shares of train and val are
    not added. `data.split.test=0.5` changes one share and leaves the others.

    Args:
        cfg: The composed configuration, changed in place.
        overrides: The command line's overrides.
    """
    for key in WHOLE:
        own = [text for text in overrides if text.lstrip("+~").startswith((f"{key}=", f"{key}."))]
        typed: set[str] | None = None
        for override in OverridesParser.create().parse_overrides(own):
            path, value = override.key_or_group, override.value()
            if path == key and isinstance(value, dict):
                typed = {str(name) for name in value}
            elif typed is not None:
                typed.add(path.removeprefix(f"{key}."))
        node = OmegaConf.select(cfg, key, default=None)
        if typed is not None and isinstance(node, DictConfig):
            with open_dict(node):
                for name in set(map(str, node)) - typed:
                    del node[name]
