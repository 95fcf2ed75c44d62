"""Settings as plain data."""

from typing import Any

from omegaconf import DictConfig, OmegaConf


def to_plain(cfg: DictConfig) -> dict[str, Any]:
    """Return settings by name, their interpolations as they are written."""
    plain = OmegaConf.to_container(cfg, resolve=False)
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items()}


def resolve(node: Any) -> Any:
    """Return a part of the settings with what it refers to."""
    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
